// Two cantilevers of quadrilaterals that reach over each other: [0, 80] x [0, 4], held at x = 0, above [40, 120] x [-6, -2], held
// at x = 120. The upper one is loaded in the point (50, 4) and touches the lower one with the point A = (80, 0) of its tip.
DefineConstant[
  n = 8,        // cells along each beam, a multiple of 8
  layers = 1    // cells through its height
];

For k In {0:1}
  p = 10 * k;
  x = 40 * k;
  y = -6 * k;
  Point(p + 1) = {x, y, 0};
  Point(p + 2) = {x + 80, y, 0};
  Point(p + 3) = {x + 80, y + 4, 0};
  Point(p + 4) = {x + 50, y + 4, 0};
  Point(p + 5) = {x, y + 4, 0};
  For i In {1:5}
    Line(p + i) = {p + i, p + (i < 5 ? i + 1 : 1)};
  EndFor
  Curve Loop(p + 1) = {p + 1 : p + 5};
  Plane Surface(p + 1) = {p + 1};
  Transfinite Curve {p + 1} = n + 1;
  Transfinite Curve {p + 2, p + 5} = layers + 1;
  Transfinite Curve {p + 3} = 3 * n / 8 + 1;
  Transfinite Curve {p + 4} = 5 * n / 8 + 1;
  Transfinite Surface {p + 1} = {p + 1, p + 2, p + 3, p + 5};
  Recombine Surface {p + 1};
EndFor

Physical Surface("upper") = {1};
Physical Surface("lower") = {11};
Physical Point("load") = {4};
Physical Point("A") = {2};
Physical Point("end") = {15};
Physical Curve("upper_held") = {5};
Physical Curve("lower_held") = {12};
Physical Curve("lower_top") = {13, 14};
