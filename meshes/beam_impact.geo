// A beam [-40, 40] x [-8, 0], to be held at both ends, and a column [-2.5, 2.5] x [1, 41] that falls on it; quadrilaterals.
DefineConstant[
  n = 1         // cells across the beam and the column; each has 8 n along its length
];

Point(1) = {-40, -8, 0};
Point(2) = { 40, -8, 0};
Point(3) = { 40,  0, 0};
Point(4) = {-40,  0, 0};
Point(11) = {-2.5,  1, 0};
Point(12) = { 2.5,  1, 0};
Point(13) = { 2.5, 41, 0};
Point(14) = {-2.5, 41, 0};
For p In {0:10:10}
  Line(p + 1) = {p + 1, p + 2};
  Line(p + 2) = {p + 2, p + 3};
  Line(p + 3) = {p + 3, p + 4};
  Line(p + 4) = {p + 4, p + 1};
  Curve Loop(p + 1) = {p + 1 : p + 4};
  Plane Surface(p + 1) = {p + 1};
  Transfinite Surface {p + 1};
  Recombine Surface {p + 1};
EndFor
Transfinite Curve {1, 3, 12, 14} = 8 * n + 1;
Transfinite Curve {2, 4, 11, 13} = n + 1;

Physical Surface("beam") = {1};
Physical Surface("column") = {11};
Physical Curve("beam_ends") = {2, 4};
Physical Curve("beam_top") = {3};
Physical Curve("column_bottom") = {11};
