// Quarter of a cord of radius R: quadrilaterals about a square core, symmetric at x = 0 and y = 0.
DefineConstant[
  R = 1,      // radius
  n = 8,      // cells along each side of the core
  order = 1   // of the cells: 2 follows the arc with curved ones
];

c = 0.45 * R;      // the core's sides
m = 0.42 * R;      // and its corner
d = R / Sqrt(2);
Point(1) = {0, 0, 0};
Point(2) = {c, 0, 0};
Point(3) = {m, m, 0};
Point(4) = {0, c, 0};
Point(5) = {R, 0, 0};
Point(6) = {d, d, 0};
Point(7) = {0, R, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};
Line(5) = {2, 5};
Circle(6) = {5, 1, 6};
Line(7) = {6, 3};
Circle(8) = {6, 1, 7};
Line(9) = {7, 4};
Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};
Curve Loop(2) = {5, 6, 7, -2};
Plane Surface(2) = {2};
Curve Loop(3) = {-7, 8, 9, -3};
Plane Surface(3) = {3};
Transfinite Curve {1 : 9} = n + 1;
Transfinite Curve {8} = 2 * n + 1;
Transfinite Curve {3, 1} = 2 * n + 1;
Transfinite Surface {1 : 3};
Recombine Surface {1 : 3};
Mesh.ElementOrder = order;

Physical Surface("cord") = {1 : 3};
Physical Curve("arc") = {6, 8};
Physical Curve("middle") = {1, 5};
Physical Curve("axis") = {4, 9};
