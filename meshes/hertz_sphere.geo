// Quarter of a half sphere (radius R, centre (0, 0, R)) on the quarter [0, W]^2 x [-W, 0] of a block; or half of both, from x = -R and -W.
//
// h scales the whole mesh: it is the size of the cells in the contact zone, and cells grow with the distance from there.
SetFactory("OpenCASCADE");
DefineConstant[
  h = 0.01,      // size in the contact zone
  ratio = 1,     // size of the block's cells over that of the sphere's; the finer body has h
  R = 1,         // radius of the sphere
  W = 2,         // width and height of the block
  zone = 0.05,   // the contact zone reaches this far from the tip
  growth = 30,   // cells at distance r are growth * h * r large
  order = 1,     // of the cells: 2 follows the sphere with curved ones
  flat = 0,      // 1: the contact zone is a disc, and cells of either body grow with the depth below it as well
  half = 0       // 1: half of both bodies, not a quarter
];
h_block = h * (ratio > 1 ? ratio : 1);
h_sphere = h / (ratio < 1 ? ratio : 1);

// the poles of the sphere's parametrisation lie on the y axis, away from the contact
Sphere(1) = {0, 0, 0, R};
Rotate {{1, 0, 0}, {0, 0, 0}, Pi / 2} { Volume{1}; }
Translate {0, 0, R} { Volume{1}; }
Box(2) = {-half * R, 0, 0, (1 + half) * R, R, R};
BooleanIntersection(3) = { Volume{1}; Delete; }{ Volume{2}; Delete; };
Box(4) = {-half * W, 0, -W, (1 + half) * W, W, W};

e = 1e-3 * R;
x0 = -half * W - e;
plane_x() = Surface In BoundingBox {-e, -e, -W - e, e, W + e, R + e};
plane_y() = Surface In BoundingBox {x0, -e, -W - e, W + e, e, R + e};
sphere_top() = Surface In BoundingBox {x0, -e, R - e, R + e, R + e, R + e};
block_top() = Surface In BoundingBox {x0, -e, -e, W + e, W + e, e};
block_bottom() = Surface In BoundingBox {x0, -e, -W - e, W + e, W + e, -W + e};
cap() = Surface In BoundingBox {x0, -e, -e, R + e, R + e, R + e};
cap() -= plane_x();
cap() -= plane_y();
cap() -= sphere_top();

Physical Volume("sphere") = {3};
Physical Volume("block") = {4};
Physical Surface("sphere_cap") = {cap()};
Physical Surface("sphere_top") = {sphere_top()};
Physical Surface("block_top") = {block_top()};
Physical Surface("block_bottom") = {block_bottom()};
If (!half)
  Physical Surface("symmetry_x") = {plane_x()};
EndIf
Physical Surface("symmetry_y") = {plane_y()};

Field[1] = MathEval;
Field[1].F = Sprintf("%g + (%g) * 0.5 * (1 + z / (Abs(z) + 1e-9)) + %g * Max(0, Sqrt(x*x + y*y + z*z) - %g)",
                     h_block, h_sphere - h_block, growth * h, zone);
If (flat)
  Field[1].F = Sprintf("%g + %g * Sqrt(Max(0, Sqrt(x*x + y*y) - %g)^2 + z*z)", h, growth * h, zone);
EndIf
Background Field = 1;
Mesh.MeshSizeFromPoints = 0;
Mesh.MeshSizeExtendFromBoundary = 0;
Mesh.ElementOrder = order;
