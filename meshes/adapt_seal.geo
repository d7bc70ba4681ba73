// Quarter of a round seal of radius R, symmetric about x = 0 and y = 0, with curved cells of one size.
DefineConstant[
  h = 0.25,      // size of all cells
  R = 1          // radius
];
Point(1) = {0, 0, 0, h};
Point(2) = {R, 0, 0, h};
Point(3) = {0, R, 0, h};
Line(1) = {1, 2};
Circle(2) = {2, 1, 3};
Line(3) = {3, 1};
Curve Loop(1) = {1:3};
Plane Surface(1) = {1};
Mesh.ElementOrder = 2;

Physical Surface("seal") = {1};
Physical Curve("middle") = {1};
Physical Curve("arc") = {2};
Physical Curve("symmetry") = {3};
