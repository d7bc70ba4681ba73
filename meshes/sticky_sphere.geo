// Half of a section of a cylinder, [0, W] x [-W, 0], whose cells of size h lie below the contact of a sphere with the top at (0, 0).
DefineConstant[
  h = 1.5e-3,    // size of the cells in the contact zone
  W = 1,         // radius and height of the cylinder
  zone = 0.13,   // radius of the contact zone
  growth = 0.3   // cells grow by so much of the distance from the zone
];

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
Curve Loop(1) = {1 : 5};
Plane Surface(1) = {1};

Physical Surface("block") = {1};
Physical Curve("bottom") = {1};
Physical Curve("top") = {4};
Physical Curve("axis") = {5};

Field[1] = MathEval;
Field[1].F = Sprintf("%g + %g * Sqrt(Max(0, x - %g)^2 + y^2)", h, growth, zone);
Background Field = 1;
Mesh.MeshSizeFromPoints = 0;
Mesh.MeshSizeExtendFromBoundary = 0;
