// Half of a beam of squares, symmetric about x = 0, that is loaded in its middle and rests on the outer part of its lower side:
// [0, length] x [0, height].
DefineConstant[
  length = 3,    // of the half
  height = 1,
  rest = 2,      // length of the part that rests, up to its end
  n = 20         // cells through the height
];
h = height / n;

Point(1) = {0, 0, 0};
Point(2) = {length - rest, 0, 0};
Point(3) = {length, 0, 0};
Point(4) = {length, height, 0};
Point(5) = {0, height, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 5};
Line(5) = {5, 1};
Curve Loop(1) = {1:5};
Plane Surface(1) = {1};
Transfinite Curve {1} = Round((length - rest) / h) + 1;
Transfinite Curve {2} = Round(rest / h) + 1;
Transfinite Curve {3, 5} = n + 1;
Transfinite Curve {4} = Round(length / h) + 1;
Transfinite Surface {1} = {1, 3, 4, 5};
Recombine Surface {1};

Physical Surface("beam") = {1};
Physical Curve("symmetry") = {5};
Physical Curve("rest") = {2};
Physical Point("edge") = {2};
Physical Point("end") = {3};
Physical Point("load") = {5};
