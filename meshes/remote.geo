// A beam of quadrilaterals along x and a flywheel above it, a ring of quadrilaterals.
DefineConstant[
  L = 6.0,        // length of the beam
  h = 1.0,        // its height, half above the x axis
  n = 18,         // cells along it
  layers = 6,     // cells across it
  R = 1.2,        // outer radius of the wheel
  r = 0.4,        // inner radius
  x = 4.8,        // where its middle is along the beam
  gap = 0.1,      // between wheel and beam
  around = 48,    // cells around the wheel, a multiple of 4
  wall = 6        // cells through its wall
];

Point(1) = {0, -h / 2, 0};
Point(2) = {L, -h / 2, 0};
Point(3) = {L, h / 2, 0};
Point(4) = {0, h / 2, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};
Curve Loop(1) = {1:4};
Plane Surface(1) = {1};
Transfinite Curve {1, 3} = n + 1;
Transfinite Curve {2, 4} = layers + 1;
Transfinite Surface {1};
Recombine Surface {1};

y = h / 2 + gap + R;
Point(5) = {x, y, 0};
// the lowest point of the rim is a node
For q In {0:3}
  Point(10 + q) = {x + r * Cos(q * Pi / 2), y + r * Sin(q * Pi / 2), 0};
  Point(20 + q) = {x + R * Cos(q * Pi / 2), y + R * Sin(q * Pi / 2), 0};
EndFor
For q In {0:3}
  next = (q + 1) % 4;
  Circle(10 + q) = {10 + q, 5, 10 + next};
  Circle(20 + q) = {20 + q, 5, 20 + next};
  Line(30 + q) = {10 + q, 20 + q};
EndFor
For q In {0:3}
  next = (q + 1) % 4;
  Curve Loop(q + 2) = {30 + q, 20 + q, -(30 + next), -(10 + q)};
  Plane Surface(q + 2) = {q + 2};
  Transfinite Curve {10 + q, 20 + q} = around / 4 + 1;
  Transfinite Curve {30 + q} = wall + 1;
  Transfinite Surface {q + 2};
  Recombine Surface {q + 2};
EndFor

Physical Surface("beam") = {1};
Physical Surface("wheel") = {2:5};
Physical Curve("root") = {4};
Physical Curve("tip") = {2};
Physical Curve("top") = {3};
Physical Curve("rim") = {20:23};
