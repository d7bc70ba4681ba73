// A quarter of the section of a billet, of quadrilaterals: [0, W] x [0, H].
DefineConstant[
  W = 1,      // half of the width
  H = 0.5,    // half of the height
  n_w = 24,   // cells along the width
  n_h = 8     // cells along the height
];

Point(1) = {0, 0, 0};
Point(2) = {W, 0, 0};
Point(3) = {W, H, 0};
Point(4) = {0, H, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {4, 3};
Line(4) = {1, 4};
Curve Loop(1) = {1, 2, -3, -4};
Plane Surface(1) = {1};
Transfinite Curve {1, 3} = n_w + 1;
Transfinite Curve {2, 4} = n_h + 1;
Transfinite Surface {1};
Recombine Surface {1};

Physical Surface("billet") = {1};
Physical Curve("middle") = {1};
Physical Curve("axis") = {4};
Physical Curve("side") = {2};
Physical Curve("face") = {3};
