// A belt around the upper half of a pulley at the origin; its ends hang down straight from where they leave it.
DefineConstant[
  R = 1,         // radius of the pulley
  t = 0.01,      // thickness of the belt
  n = 80,        // cells along the half circle
  layers = 2,    // cells through the belt
  free = 0.1     // length of the straight ends
];

Point(1) = {0, 0, 0};
For k In {0:1}
  r = R + k * t;
  Point(10 + k) = {-r, -free, 0};
  Point(20 + k) = {-r, 0, 0};
  Point(30 + k) = {0, r, 0};
  Point(40 + k) = {r, 0, 0};
  Point(50 + k) = {r, -free, 0};
  Line(10 + k) = {10 + k, 20 + k};
  Circle(20 + k) = {20 + k, 1, 30 + k};
  Circle(30 + k) = {30 + k, 1, 40 + k};
  Line(40 + k) = {40 + k, 50 + k};
  Transfinite Curve {20 + k, 30 + k} = n / 2 + 1;
  Transfinite Curve {10 + k, 40 + k} = Ceil(n * free / (Pi * R)) + 1;
EndFor
For i In {1:5}
  Line(i) = {10 * i, 10 * i + 1};
  Transfinite Curve {i} = layers + 1;
EndFor
For i In {1:4}
  Curve Loop(i) = {10 * i, i + 1, -(10 * i + 1), -i};
  Plane Surface(i) = {i};
  Transfinite Surface {i};
EndFor
Recombine Surface {:};

Physical Surface("belt") = {1:4};
Physical Curve("inside") = {20, 30};
Physical Curve("slack_end") = {1};
Physical Curve("tight_end") = {5};
