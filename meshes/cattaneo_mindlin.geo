// A half disc (radius R, flat side up at y = R) on a block [-W, W] x [-W, 0]; cells are finest in the contact zone.
DefineConstant[
  h = 1/40,      // size in the contact zone, as part of its reach
  R = 1,         // radius of the disc
  W = 1,         // half the width, and height, of the block
  zone = 0.03,   // the contact zone reaches this far to either side
  growth = 0.25  // cells at distance r are growth * r larger
];
size = h * zone;

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
Curve Loop(1) = {1:6};
Plane Surface(1) = {1};

angle = Asin(zone / R);
Point(10) = {0, R, 0};
Point(11) = {-R, R, 0};
Point(12) = {-R * Sin(angle), R * (1 - Cos(angle)), 0};
Point(13) = {0, 0, 0};
Point(14) = {R * Sin(angle), R * (1 - Cos(angle)), 0};
Point(15) = {R, R, 0};
Circle(11) = {11, 10, 12};
Circle(12) = {12, 10, 13};
Circle(13) = {13, 10, 14};
Circle(14) = {14, 10, 15};
Line(15) = {15, 10};
Line(16) = {10, 11};
Curve Loop(2) = {11:16};
Plane Surface(2) = {2};

Transfinite Curve {4} = 2 * Round(1 / h) + 1;
Transfinite Curve {12, 13} = Round(1 / h) + 1;
Field[1] = MathEval;
Field[1].F = Sprintf("%g + %g * Max(0, Sqrt(x*x + y*y) - %g)", size, growth, zone);
Background Field = 1;
Mesh.MeshSizeFromPoints = 0;
Mesh.MeshSizeExtendFromBoundary = 0;
Mesh.Algorithm = 6;

Physical Surface("block") = {1};
Physical Surface("disc") = {2};
Physical Curve("block_top") = {3, 4, 5};
Physical Curve("block_bottom") = {1};
Physical Curve("disc_arc") = {11:14};
Physical Curve("disc_top") = {15, 16};
