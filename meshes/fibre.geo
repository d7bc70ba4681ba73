// Half of an axial section of a fibre in a matrix: [0, r] x [-L, 0] in [r, R] x [-L, 0], that are separate and have matching faces.
DefineConstant[
  r = 0.1,      // radius of the fibre
  R = 0.3,      // radius of the matrix
  L = 4,        // embedded length
  size = 0.05   // length of the cells along the fibre
];

For k In {0:1}
  p = 10 * k;
  from = k ? r : 0;
  to = k ? R : r;
  Point(p + 1) = {from, -L, 0};
  Point(p + 2) = {to, -L, 0};
  Point(p + 3) = {to, 0, 0};
  Point(p + 4) = {from, 0, 0};
  Line(p + 1) = {p + 1, p + 2};
  Line(p + 2) = {p + 2, p + 3};
  Line(p + 3) = {p + 3, p + 4};
  Line(p + 4) = {p + 4, p + 1};
  Curve Loop(p + 1) = {p + 1 : p + 4};
  Plane Surface(p + 1) = {p + 1};
  Transfinite Curve {p + 1, p + 3} = Ceil((to - from) / size) + 1;
  Transfinite Curve {p + 2, p + 4} = Ceil(L / size) + 1;
  Transfinite Surface {p + 1};
  Recombine Surface {p + 1};
EndFor

Physical Surface("fibre") = {1};
Physical Surface("matrix") = {11};
Physical Curve("axis") = {4};
Physical Curve("fibre_face") = {2};
Physical Curve("fibre_end") = {3};
Physical Curve("hole") = {14};
Physical Curve("outside") = {12};
Physical Curve("matrix_top") = {13};
