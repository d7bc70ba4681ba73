// A tube, out of round by a part e of its radius: wider along x, narrower along y.
DefineConstant[
  R = 1,       // radius of the middle of the wall
  t = 0.1,     // thickness of the wall
  e = 0.003,   // by how much it is out of round
  n = 240,     // cells around, a multiple of 4
  layers = 4   // cells through the wall
];

Point(100) = {0, 0, 0};
For q In {0:3}
  turn = q * Pi / 2;
  more = R * e * Cos(2 * turn);
  Point(q + 1) = {(R - t / 2 + more) * Cos(turn), (R - t / 2 + more) * Sin(turn), 0};
  Point(q + 11) = {(R + t / 2 + more) * Cos(turn), (R + t / 2 + more) * Sin(turn), 0};
  Line(q + 21) = {q + 1, q + 11};
EndFor
For q In {0:3}
  next = (q + 1) % 4;
  Ellipse(q + 1) = {q + 1, 100, 1, next + 1};
  Ellipse(q + 11) = {q + 11, 100, 11, next + 11};
  Curve Loop(q + 1) = {q + 21, q + 11, -(next + 21), -(q + 1)};
  Plane Surface(q + 1) = {q + 1};
  Transfinite Curve {q + 1, q + 11} = n / 4 + 1;
  Transfinite Curve {q + 21} = layers + 1;
EndFor
For q In {0:3}
  next = (q + 1) % 4;
  Transfinite Surface {q + 1} = {q + 1, q + 11, next + 11, next + 1};
  Recombine Surface {q + 1};
EndFor

Physical Surface("tube") = {1:4};
Physical Curve("outside") = {11:14};
Physical Curve("sections_x") = {21, 23};
Physical Curve("sections_y") = {22, 24};
