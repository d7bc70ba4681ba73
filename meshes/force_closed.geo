// Half disc (radius R, flat side up, centre (0, gap + R)) above a block [-W, W] x [-W, 0].
//
// h scales the whole mesh: it is the size of the finer body's cells in the contact zone, and cells grow with the
// distance from there.
DefineConstant[
  h = 1/60,      // size in the contact zone
  ratio = 1.5,   // size of the block's cells over that of the disc's; the finer body has h
  gap = 0.05,    // distance of the disc's lowest point from the block
  R = 3,         // radius of the disc
  W = 6,         // half the width, and height, of the block
  zone = 0.15,   // the contact zone reaches this far from the tip
  growth = 6,    // cells at distance r are growth * h * r large
  order = 1      // of the cells: 2 follows the arc with curved ones
];
h_block = h * (ratio > 1 ? ratio : 1);
h_disc = h / (ratio < 1 ? ratio : 1);

Point(1) = {-W, -W, 0};
Point(2) = {W, -W, 0};
Point(3) = {W, 0, 0};
Point(4) = {zone, 0, 0};
Point(5) = {-zone, 0, 0};
Point(6) = {-W, 0, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 5};
Line(5) = {5, 6};
Line(6) = {6, 1};
Curve Loop(1) = {1, 2, 3, 4, 5, 6};
Plane Surface(1) = {1};

angle = zone / R;
Point(10) = {0, gap + R, 0};
Point(11) = {-R, gap + R, 0};
Point(12) = {-R * Sin(angle), gap + R * (1 - Cos(angle)), 0};
Point(13) = {R * Sin(angle), gap + R * (1 - Cos(angle)), 0};
Point(14) = {R, gap + R, 0};
Circle(11) = {11, 10, 12};
Circle(12) = {12, 10, 13};
Circle(13) = {13, 10, 14};
Line(14) = {14, 11};
Curve Loop(2) = {11, 12, 13, 14};
Plane Surface(2) = {2};

Transfinite Curve {4} = 2 * Ceil(zone / h_block) + 1;
Transfinite Curve {12} = 2 * Ceil(zone / h_disc) + 1;
Field[1] = MathEval;
// below y_mid is the block, above it the disc
y_mid = 0.5 * gap;
Field[1].F = Sprintf("%g + (%g) * 0.5 * (1 + (y - (%g)) / (Abs(y - (%g)) + 1e-9)) + %g * Max(0, Sqrt(x*x + y*y) - %g)",
                     h_block, h_disc - h_block, y_mid, y_mid, growth * h, zone);
Background Field = 1;
Mesh.MeshSizeFromPoints = 0;
Mesh.MeshSizeExtendFromBoundary = 0;
Mesh.Algorithm = 6;

Physical Surface("block") = {1};
Physical Surface("disc") = {2};
Physical Curve("block_top") = {3, 4, 5};
Physical Curve("block_bottom") = {1};
Physical Curve("disc_arc") = {11, 12, 13};
Physical Curve("disc_top") = {14};
Mesh.ElementOrder = order;
