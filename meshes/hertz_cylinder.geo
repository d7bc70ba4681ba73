// Quarter disc (radius R, centre (0, R)) on a block [0, W] x [-W, 0], symmetric about x = 0.
//
// h scales the whole mesh: it is the size of the finer body's cells in the contact zone, and cells grow with the
// distance from there.
DefineConstant[
  h = 1/120,     // size in the contact zone
  ratio = 1,     // size of the block's cells over that of the disc's; the finer body has h
  R = 3,         // radius of the disc
  W = 6,         // width and height of the block
  zone = 0.15,   // the contact zone reaches this far from the tip
  growth = 6,    // cells at distance r are growth * h * r large
  quads = 0,     // 1: quadrilaterals
  order = 1      // of the cells: 2 follows the arc with curved ones
];
h_block = h * (ratio > 1 ? ratio : 1);
h_disc = h / (ratio < 1 ? ratio : 1);

Point(1) = {0, -W, 0};
Point(2) = {W, -W, 0};
Point(3) = {W, 0, 0};
Point(4) = {zone, 0, 0};
Point(5) = {0, 0, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 5};
Line(5) = {5, 1};
Curve Loop(1) = {1, 2, 3, 4, 5};
Plane Surface(1) = {1};

angle = zone / R;
Point(10) = {0, R, 0};
Point(11) = {0, 0, 0};
Point(12) = {R * Sin(angle), R * (1 - Cos(angle)), 0};
Point(13) = {R, R, 0};
Circle(11) = {11, 10, 12};
Circle(12) = {12, 10, 13};
Line(13) = {13, 10};
Line(14) = {10, 11};
Curve Loop(2) = {11, 12, 13, 14};
Plane Surface(2) = {2};

// where all cells are quadrilaterals each curve has an even number
by = quads ? 2 : 1;
Transfinite Curve {4} = by * Ceil(zone / h_block / by) + 1;
Transfinite Curve {11} = by * Ceil(zone / h_disc / by) + 1;
Field[1] = MathEval;
Field[1].F = Sprintf("%g + (%g) * 0.5 * (1 + y / (Abs(y) + 1e-9)) + %g * Max(0, Sqrt(x*x + y*y) - %g)",
                     h_block, h_disc - h_block, growth * h, zone);
Background Field = 1;
Mesh.MeshSizeFromPoints = 0;
Mesh.MeshSizeExtendFromBoundary = 0;
Mesh.Algorithm = 6;
Mesh.ElementOrder = order;
If (quads)
  Recombine Surface {1, 2};
  Mesh.RecombinationAlgorithm = 3;
EndIf

Physical Surface("block") = {1};
Physical Surface("disc") = {2};
Physical Curve("block_top") = {3, 4};
Physical Curve("block_bottom") = {1};
Physical Curve("disc_arc") = {11, 12};
Physical Curve("disc_top") = {13};
Physical Curve("symmetry") = {5, 14};
