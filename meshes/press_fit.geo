// Quarter of a solid disc (radius b + delta) in a ring (radii b and c), both about the origin: they overlap by delta.
DefineConstant[
  b = 1,         // inner radius of the ring
  c = 2,         // outer radius of the ring
  delta = 0.001, // what the disc's radius has too much
  h = 0.05,      // size of the disc's cells at the interface
  ratio = 1.5,   // size of the ring's cells over that of the disc's at the interface
  grade = 3,     // size of the cells at the disc's centre and at the ring's outside over that at the interface
  order = 2      // degree of the geometry: 2 has cells with curved sides
];

Point(1) = {0, 0, 0, grade * h};
Point(2) = {b + delta, 0, 0, h};
Point(3) = {0, b + delta, 0, h};
Line(1) = {1, 2};
Circle(2) = {2, 1, 3};
Line(3) = {3, 1};
Curve Loop(1) = {1, 2, 3};
Plane Surface(1) = {1};
Transfinite Curve {2} = Ceil((b + delta) * Pi / 2 / h) + 1;

// a centre of its own leaves the bodies without a common point
Point(10) = {0, 0, 0};
Point(11) = {b, 0, 0, ratio * h};
Point(12) = {c, 0, 0, grade * ratio * h};
Point(13) = {0, c, 0, grade * ratio * h};
Point(14) = {0, b, 0, ratio * h};
Line(11) = {11, 12};
Circle(12) = {12, 10, 13};
Line(13) = {13, 14};
Circle(14) = {14, 10, 11};
Curve Loop(11) = {11, 12, 13, 14};
Plane Surface(11) = {11};
Transfinite Curve {14} = Ceil(b * Pi / 2 / (ratio * h)) + 1;

Physical Surface("disc") = {1};
Physical Surface("ring") = {11};
Physical Curve("disc_arc") = {2};
Physical Curve("ring_bore") = {14};
Physical Curve("ring_outside") = {12};
Physical Curve("symmetry_x") = {3, 13};
Physical Curve("symmetry_y") = {1, 11};
Mesh.ElementOrder = order;
