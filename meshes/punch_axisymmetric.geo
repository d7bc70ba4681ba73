// Half section, through the axis x = 0, of a punch with a rounded edge that stands on a cylinder; lengths in mm.
DefineConstant[
  r = 50,       // radius of the punch
  height = 100, // of the punch
  fillet = 10,  // radius of its edge
  R = 100,      // radius of the foundation
  depth = 200,  // of the foundation
  n = 12,       // cells around a quarter of the rounded edge
  ratio = 1.3,  // size of the foundation's cells over that of the punch's at the edge of the contact
  grade = 12,   // size of cells far away over that there
  order = 2     // degree of the geometry: 2 has cells with curved sides
];

h = fillet * Pi / 2 / n;
flat = r - fillet;
Point(1) = {0, 0, 0, 4 * h};
Point(2) = {flat, 0, 0, h};
Point(3) = {r, fillet, 0, h};
Point(4) = {r, height, 0, grade * h};
Point(5) = {0, height, 0, grade * h};
Point(6) = {flat, fillet, 0};
Line(1) = {1, 2};
Circle(2) = {2, 6, 3};
Line(3) = {3, 4};
Line(4) = {4, 5};
Line(5) = {5, 1};
Curve Loop(1) = {1:5};
Plane Surface(1) = {1};

k = ratio * h;
Point(11) = {0, -depth, 0, grade * k};
Point(12) = {R, -depth, 0, grade * k};
Point(13) = {R, 0, 0, grade * k};
Point(14) = {flat, 0, 0, k};
Point(15) = {0, 0, 0, 4 * k};
Line(11) = {11, 12};
Line(12) = {12, 13};
Line(13) = {13, 14};
Line(14) = {14, 15};
Line(15) = {15, 11};
Curve Loop(11) = {11:15};
Plane Surface(11) = {11};

Physical Surface("punch") = {1};
Physical Surface("foundation") = {11};
Physical Curve("punch_face") = {1, 2};
Physical Curve("foundation_top") = {13, 14};
Physical Curve("top") = {4};
Physical Curve("bottom") = {11};
Physical Curve("axis") = {5, 15};
Physical Point("centre") = {15};
Mesh.ElementOrder = order;
