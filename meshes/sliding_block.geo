// A block on [0, length] x [0, height], its tail pushed on the upper half, alone or on a base that reaches `apron` further on either side; all cells are alike.
DefineConstant[
  n = 8,           // cells along the block's height, an even number
  length = 2,      // of the block
  height = 0.5,    // of the block
  base = 1,        // 0: no base, as for a rigid one
  apron = 0.5,     // length of the base on either side of the block
  depth = 0.5,     // of the base
  n_base = 5       // cells through the base, which need not match
];

Point(1) = {0, 0, 0};
Point(2) = {length, 0, 0};
Point(3) = {length, height, 0};
Point(4) = {0, height, 0};
Point(5) = {0, height / 2, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 5};
Line(5) = {5, 1};
Curve Loop(1) = {1:5};
Plane Surface(1) = {1};
Transfinite Curve {2} = n + 1;
Transfinite Curve {4, 5} = n / 2 + 1;
Transfinite Curve {1, 3} = Round(n * length / height) + 1;
Transfinite Surface {1} = {1, 2, 3, 4};

Physical Surface("block") = {1};
Physical Curve("block_bottom") = {1};
Physical Curve("block_tail") = {4};

If (base)
  Point(11) = {-apron, -depth, 0};
  Point(12) = {length + apron, -depth, 0};
  Point(13) = {length + apron, 0, 0};
  Point(14) = {-apron, 0, 0};
  Line(11) = {11, 12};
  Line(12) = {12, 13};
  Line(13) = {13, 14};
  Line(14) = {14, 11};
  Curve Loop(2) = {11:14};
  Plane Surface(2) = {2};
  Transfinite Curve {12, 14} = n_base + 1;
  Transfinite Curve {11, 13} = Round(n_base * (length + 2 * apron) / depth) + 1;
  Transfinite Surface {2};
  Physical Surface("base") = {2};
  Physical Curve("base_bottom") = {11};
  Physical Curve("base_top") = {13};
EndIf
Recombine Surface {:};
