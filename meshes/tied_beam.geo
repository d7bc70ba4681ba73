// A cantilever of length l and height 1: of two parts that meet at l/2 and have their own cells, or of one.
DefineConstant[
  l = 10,      // length
  n_1 = 3,     // cells over the height of the part at the support
  n_2 = 4,     // of the other part
  parts = 2    // 1: one piece with the cells of the first part
];
length() = {parts == 2 ? l / 2 : l, l / 2};
height() = {n_1, n_2};

For k In {0 : parts - 1}
  s = 10 * k;
  Point(s + 1) = {k * l / 2, 0, 0};
  Point(s + 2) = {k * l / 2 + length(k), 0, 0};
  Point(s + 3) = {k * l / 2 + length(k), 1, 0};
  Point(s + 4) = {k * l / 2, 1, 0};
  For q In {1:4}
    Line(s + q) = {s + q, s + q % 4 + 1};
  EndFor
  Curve Loop(s + 1) = {s + 1, s + 2, s + 3, s + 4};
  Plane Surface(s + 1) = {s + 1};
  Transfinite Curve {s + 1, s + 3} = Round(length(k) * height(k)) + 1;
  Transfinite Curve {s + 2, s + 4} = height(k) + 1;
  Transfinite Surface {s + 1};
  Recombine Surface {s + 1};
EndFor

Physical Surface("beam") = {1 : 10 * (parts - 1) + 1 : 10};
Physical Curve("support") = {4};
Physical Curve("end") = {10 * (parts - 1) + 2};
If (parts == 2)
  Physical Curve("end_1") = {2};
  Physical Curve("start_2") = {14};
EndIf
