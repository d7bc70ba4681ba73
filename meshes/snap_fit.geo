// A clip of quadrilaterals: an arm [0, l] x [0, h], and a head whose lower side is a ramp from (l + a, -tip) down to (l, -hook); and a
// wall, whose upper corner is on the ramp near its tip.
DefineConstant[
  l = 20,      // length of the arm
  h = 2,       // thickness of the arm
  a = 4,       // length of the head
  hook = 1,    // depth of the ramp's end below the arm
  tip = 0.4,   // depth of its tip
  start = 0.5, // length from the tip to the corner
  n = 6        // cells through the arm
];

Point(1) = {0, 0, 0};
Point(2) = {l, 0, 0};
Point(3) = {l + a, 0, 0};
Point(4) = {l + a, h, 0};
Point(5) = {l, h, 0};
Point(6) = {0, h, 0};
Point(7) = {l, -hook, 0};
Point(8) = {l + a, -tip, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 5};
Line(5) = {5, 6};
Line(6) = {6, 1};
Line(7) = {2, 5};
Line(8) = {2, 7};
Line(9) = {7, 8};
Line(10) = {8, 3};
Curve Loop(1) = {1, 7, 5, 6};
Plane Surface(1) = {1};
Curve Loop(2) = {2, 3, 4, -7};
Plane Surface(2) = {2};
Curve Loop(3) = {8, 9, 10, -2};
Plane Surface(3) = {3};

x = l + a - start;
y = -tip - start * (hook - tip) / a;
Point(11) = {x, y, 0};
Point(12) = {x, y - h, 0};
Point(13) = {x + h, y - h, 0};
Point(14) = {x + h, y, 0};
Line(11) = {11, 12};
Line(12) = {12, 13};
Line(13) = {13, 14};
Line(14) = {14, 11};
Curve Loop(4) = {11:14};
Plane Surface(4) = {4};

Transfinite Curve {1, 5} = Round(n * l / h / 1.5) + 1;
Transfinite Curve {2, 4, 9} = Round(n * a / h) + 1;
Transfinite Curve {3, 6, 7} = n + 1;
Transfinite Curve {8, 10} = Round(n / 2) + 1;
Transfinite Curve {11:14} = 2;
Transfinite Surface {1:4};
Recombine Surface {1:4};

Physical Surface("clip") = {1:3};
Physical Surface("wall") = {4};
Physical Curve("root") = {6};
Physical Curve("top") = {5};
Physical Curve("ramp") = {9};
Physical Curve("wall_sides") = {11:14};
Physical Point("corner") = {11};
