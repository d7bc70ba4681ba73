// Two bodies that face each other along y = 0: [-1, 1] x [-1, 0] below and [-1, 1] x [gap, 1 + gap] above.
//
// All cells are alike, and the origin is a node of both bodies; with n_upper = n_lower the meshes match.
DefineConstant[
  n_lower = 8,   // cells along each unit of length of the lower body
  n_upper = 12,  // cells along each unit of length of the upper body
  gap = 0,       // between them at the start
  quads = 1      // 0: triangles
];
y() = {-1, gap};
n() = {n_lower, n_upper};

For k In {0 : 1}
  p = 10 * k;
  Point(p + 1) = {-1, y(k), 0};
  Point(p + 2) = {1, y(k), 0};
  Point(p + 3) = {1, y(k) + 1, 0};
  Point(p + 4) = {-1, y(k) + 1, 0};
  Line(p + 1) = {p + 1, p + 2};
  Line(p + 2) = {p + 2, p + 3};
  Line(p + 3) = {p + 3, p + 4};
  Line(p + 4) = {p + 4, p + 1};
  Curve Loop(p + 1) = {p + 1 : p + 4};
  Plane Surface(p + 1) = {p + 1};
  Transfinite Curve {p + 1, p + 3} = 2 * n(k) + 1;
  Transfinite Curve {p + 2, p + 4} = n(k) + 1;
  Transfinite Surface {p + 1};
  If (quads)
    Recombine Surface {p + 1};
  EndIf
EndFor

Physical Surface("lower") = {1};
Physical Surface("upper") = {11};
Physical Curve("lower_top") = {3};
Physical Curve("upper_bottom") = {11};
Physical Curve("lower_outside") = {1, 2, 4};
Physical Curve("upper_outside") = {12, 13, 14};
