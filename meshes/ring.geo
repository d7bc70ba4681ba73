// A ring of quadrilaterals around the origin.
DefineConstant[
  R = 1.0,        // outer radius
  r = 0.7,        // inner radius
  n = 64,         // cells around, a multiple of 4
  layers = 4      // cells through the wall
];

Point(1) = {0, 0, 0};
For q In {0:3}
  Point(10 + q) = {r * Cos(q * Pi / 2), r * Sin(q * Pi / 2), 0};
  Point(20 + q) = {R * Cos(q * Pi / 2), R * Sin(q * Pi / 2), 0};
EndFor
For q In {0:3}
  next = (q + 1) % 4;
  Circle(10 + q) = {10 + q, 1, 10 + next};
  Circle(20 + q) = {20 + q, 1, 20 + next};
  Line(30 + q) = {10 + q, 20 + q};
EndFor
For q In {0:3}
  next = (q + 1) % 4;
  Curve Loop(q + 1) = {30 + q, 20 + q, -(30 + next), -(10 + q)};
  Plane Surface(q + 1) = {q + 1};
  Transfinite Curve {10 + q, 20 + q} = n / 4 + 1;
  Transfinite Curve {30 + q} = layers + 1;
  Transfinite Surface {q + 1};
  Recombine Surface {q + 1};
EndFor

Physical Surface("ring") = {1:4};
Physical Curve("outside") = {20:23};
Physical Curve("inside") = {10:13};
