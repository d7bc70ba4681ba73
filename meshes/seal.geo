// Half of a rubber seal in its groove: a rectangle, whose upper side is a profile to be found.
DefineConstant[
  n = 12,          // number of cells along the profile
  w = 1,           // half of its width
  height = 0.8     // of the rectangle
];
Point(1) = {0, 0, 0};
Point(2) = {w, 0, 0};
Point(3) = {w, height, 0};
Point(4) = {0, height, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};
Transfinite Curve {1, 3} = n + 1;
Transfinite Curve {2, 4} = Round(height / w * n) + 1;
Transfinite Surface {1};
Physical Surface("seal") = {1};
Physical Curve("groove") = {1};
Physical Curve("profile") = {3};
Physical Curve("symmetry") = {4};
