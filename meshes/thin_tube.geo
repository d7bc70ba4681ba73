// Half of the section of a round tube along y, of quadrilaterals: a body of revolution about x = 0.
DefineConstant[
  R = 20,     // mean radius
  t = 2,      // thickness of the wall
  L = 60,     // length
  n = 2       // cells through the thickness
];

Point(1) = {R - t / 2, 0, 0};
Point(2) = {R + t / 2, 0, 0};
Point(3) = {R + t / 2, L, 0};
Point(4) = {R - t / 2, L, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {4, 3};
Line(4) = {1, 4};
Curve Loop(1) = {1, 2, -3, -4};
Plane Surface(1) = {1};
Transfinite Curve {1, 3} = n + 1;
Transfinite Curve {2, 4} = Round(L * n / t) + 1;
Transfinite Surface {1};
Recombine Surface {1};

Physical Surface("tube") = {1};
Physical Curve("bottom") = {1};
Physical Curve("outside") = {2};
Physical Curve("top") = {3};
Physical Curve("inside") = {4};
