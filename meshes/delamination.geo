// Double cantilever beam of quadrilaterals: two arms [0, length] x [-height, 0] and [0, length] x [0, height], that are separate.
//
// They are cracked on [0, crack], and face each other on the bonded faces beyond. Points for supports and loads: the lower corners, and the
// left end and the middle of the upper arm's top.
DefineConstant[
  length = 100,   // of the arms
  height = 5,     // of each arm
  crack = 40,     // initial length of the crack
  middle = (crack + length) / 2,  // of the point of load on top, beyond the crack
  size = 1.25,    // length of the cells
  n = 2           // cells across each arm
];

For k In {0:1}
  p = 10 * k;
  side = k ? 1 : -1;
  Point(p + 1) = {0, 0, 0};
  Point(p + 2) = {crack, 0, 0};
  Point(p + 3) = {length, 0, 0};
  Point(p + 4) = {length, side * height, 0};
  Point(p + 5) = {crack, side * height, 0};
  Point(p + 6) = {0, side * height, 0};
  Point(p + 7) = {middle, 0, 0};
  Point(p + 8) = {middle, side * height, 0};
  Line(p + 1) = {p + 1, p + 2};
  Line(p + 2) = {p + 2, p + 7};
  Line(p + 8) = {p + 7, p + 3};
  Line(p + 3) = {p + 3, p + 4};
  Line(p + 4) = {p + 8, p + 5};
  Line(p + 9) = {p + 4, p + 8};
  Line(p + 5) = {p + 5, p + 6};
  Line(p + 6) = {p + 6, p + 1};
  Line(p + 7) = {p + 2, p + 5};
  Line(p + 10) = {p + 7, p + 8};
  Curve Loop(p + 1) = {p + 1, p + 7, p + 5, p + 6};
  Curve Loop(p + 2) = {p + 2, p + 10, p + 4, -(p + 7)};
  Curve Loop(p + 3) = {p + 8, p + 3, p + 9, -(p + 10)};
  Plane Surface(p + 1) = {p + 1};
  Plane Surface(p + 2) = {p + 2};
  Plane Surface(p + 3) = {p + 3};
  Transfinite Curve {p + 3, p + 6, p + 7, p + 10} = n + 1;
  Transfinite Curve {p + 1, p + 5} = Ceil(crack / size) + 1;
  Transfinite Curve {p + 2, p + 4} = Ceil((middle - crack) / size) + 1;
  Transfinite Curve {p + 8, p + 9} = Ceil((length - middle) / size) + 1;
  Transfinite Surface {p + 1, p + 2, p + 3};
  Recombine Surface {p + 1, p + 2, p + 3};
EndFor

Physical Surface("lower") = {1, 2, 3};
Physical Surface("upper") = {11, 12, 13};
Physical Curve("lower_crack") = {1};
Physical Curve("upper_crack") = {11};
Physical Curve("lower_bond") = {2, 8};
Physical Curve("upper_bond") = {12, 18};
Physical Curve("lower_left") = {6};
Physical Curve("upper_left") = {16};
Physical Curve("lower_right") = {3};
Physical Curve("upper_right") = {13};
Physical Point("lower_left_corner") = {6};
Physical Point("lower_right_corner") = {4};
Physical Point("upper_left_corner") = {16};
Physical Point("upper_middle") = {18};
