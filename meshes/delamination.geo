// Double cantilever beam of quadrilaterals: two arms [0, length] x [-height, 0] and [0, length] x [0, height], that are separate.
//
// They are cracked on [0, crack], and face each other on the bonded faces beyond.
DefineConstant[
  length = 100,   // of the arms
  height = 5,     // of each arm
  crack = 40,     // initial length of the crack
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
  Line(p + 1) = {p + 1, p + 2};
  Line(p + 2) = {p + 2, p + 3};
  Line(p + 3) = {p + 3, p + 4};
  Line(p + 4) = {p + 4, p + 5};
  Line(p + 5) = {p + 5, p + 6};
  Line(p + 6) = {p + 6, p + 1};
  Line(p + 7) = {p + 2, p + 5};
  Curve Loop(p + 1) = {p + 1, p + 7, p + 5, p + 6};
  Curve Loop(p + 2) = {p + 2, p + 3, p + 4, -(p + 7)};
  Plane Surface(p + 1) = {p + 1};
  Plane Surface(p + 2) = {p + 2};
  Transfinite Curve {p + 3, p + 6, p + 7} = n + 1;
  Transfinite Curve {p + 1, p + 5} = Ceil(crack / size) + 1;
  Transfinite Curve {p + 2, p + 4} = Ceil((length - crack) / size) + 1;
  Transfinite Surface {p + 1, p + 2};
  Recombine Surface {p + 1, p + 2};
EndFor

Physical Surface("lower") = {1, 2};
Physical Surface("upper") = {11, 12};
Physical Curve("lower_crack") = {1};
Physical Curve("upper_crack") = {11};
Physical Curve("lower_bond") = {2};
Physical Curve("upper_bond") = {12};
Physical Curve("lower_left") = {6};
Physical Curve("upper_left") = {16};
Physical Curve("lower_right") = {3};
Physical Curve("upper_right") = {13};
