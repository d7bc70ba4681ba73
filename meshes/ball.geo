// Half section, through the axis x = 0, of a ball of radius R whose lowest point is `gap` above the origin.
DefineConstant[
  R = 1,
  gap = 1e-4,
  zone = 0.15,  // the fine part of the surface reaches this far from the axis
  h = 0.01,     // size of the cells there
  grow = 0.25,  // growth of cells with the distance from it
  coarse = 0.12 // size of the largest cells
];

Point(1) = {0, gap, 0};
Point(2) = {zone, gap + R - Sqrt(R * R - zone * zone), 0};
Point(3) = {R, gap + R, 0};
Point(4) = {0, gap + 2 * R, 0};
Point(5) = {0, gap + R, 0};
Circle(1) = {1, 5, 2};
Circle(2) = {2, 5, 3};
Circle(3) = {3, 5, 4};
Line(4) = {4, 1};
Curve Loop(1) = {1:4};
Plane Surface(1) = {1};

Field[1] = MathEval;
Field[1].F = Sprintf("%g + %g * 0.5 * (abs(sqrt(x^2 + (y - %g)^2) - %g) + sqrt(x^2 + (y - %g)^2) - %g)", h, grow, gap, zone, gap, zone);
Mesh.MeshSizeMax = coarse;
Background Field = 1;
Mesh.MeshSizeExtendFromBoundary = 0;
Mesh.MeshSizeFromPoints = 0;

Physical Surface("ball") = {1};
Physical Curve("face") = {1};
Physical Curve("axis") = {4};
