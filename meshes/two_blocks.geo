// Two unit squares of quadrilaterals, one upon the other: [0, 1] x [0, 1] and [0, 1] x [1, 2].
//
// With n_upper a multiple of n_lower, or the other way round, the nodes of the finer side contain those of the coarser.
DefineConstant[
  n_lower = 4,   // cells along each side of the lower block
  n_upper = 8    // cells along each side of the upper block
];

For k In {0:1}
  p = 10 * k;
  Point(p + 1) = {0, k, 0};
  Point(p + 2) = {1, k, 0};
  Point(p + 3) = {1, k + 1, 0};
  Point(p + 4) = {0, k + 1, 0};
  Line(p + 1) = {p + 1, p + 2};
  Line(p + 2) = {p + 2, p + 3};
  Line(p + 3) = {p + 3, p + 4};
  Line(p + 4) = {p + 4, p + 1};
  Curve Loop(p + 1) = {p + 1 : p + 4};
  Plane Surface(p + 1) = {p + 1};
  Transfinite Curve {p + 1 : p + 4} = (k ? n_upper : n_lower) + 1;
  Transfinite Surface {p + 1};
  Recombine Surface {p + 1};
EndFor

Physical Surface("lower") = {1};
Physical Surface("upper") = {11};
Physical Curve("lower_bottom") = {1};
Physical Curve("lower_top") = {3};
Physical Curve("upper_bottom") = {11};
Physical Curve("upper_top") = {13};
Physical Curve("sides") = {2, 4, 12, 14};
