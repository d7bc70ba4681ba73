// Two pins over a floor at y = 0: a flat one [-2, -1] x [0, 1], and half of a round one, a quarter disc of radius R with its centre
// at (0, R), symmetric about x = 0.
DefineConstant[
  h = 1/250,     // size of the round pin's cells in the contact zone
  R = 1,         // radius of the round pin
  zone = 0.05,   // the contact zone reaches this far from the tip
  growth = 30,   // cells at distance r are growth * h * r large
  n = 4          // divisions of the flat pin
];

Point(1) = {-2, 0, 0};
Point(2) = {-1, 0, 0};
Point(3) = {-1, 1, 0};
Point(4) = {-2, 1, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};
Transfinite Curve {1, 2, 3, 4} = n + 1;
Transfinite Surface {1};

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
Transfinite Curve {11} = Ceil(zone / h) + 1;
Field[1] = MathEval;
Field[1].F = Sprintf("%g + %g * Max(0, Sqrt(x*x + y*y) - %g)", h, growth * h, zone);
Background Field = 1;
Mesh.MeshSizeFromPoints = 0;
Mesh.MeshSizeExtendFromBoundary = 0;
Mesh.Algorithm = 6;

Physical Surface("flat") = {1};
Physical Surface("round") = {2};
Physical Curve("flat_foot") = {1};
Physical Curve("flat_top") = {3};
Physical Curve("flat_side") = {2, 4};
Physical Curve("round_foot") = {11, 12};
Physical Curve("round_top") = {13};
Physical Curve("symmetry") = {14};
