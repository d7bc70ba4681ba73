// A punch of half width a above a large base, the right half of both: [0, a] x [gap, gap + a/2] and [0, width] x [-width, 0].
DefineConstant[
  a = 1,         // half width of the punch
  n = 20,        // cells along its bottom
  gap = 0.02,    // between the two
  width = 40,    // of half the base, and its depth
  coarse = 4     // size of the cells far away
];
h = a / n;

// base, with cells as fine as those of the punch below it
Point(1) = {0, 0, 0, h};
Point(2) = {a, 0, 0, h};
Point(3) = {2 * a, 0, 0, 2 * h};
Point(4) = {width, 0, 0, coarse};
Point(5) = {width, -width, 0, coarse};
Point(6) = {0, -width, 0, coarse};
Line(1) = {6, 5};
Line(2) = {5, 4};
Line(3) = {4, 3};
Line(4) = {3, 2};
Line(5) = {2, 1};
Line(6) = {1, 6};
Curve Loop(1) = {1:6};
Plane Surface(1) = {1};

Point(11) = {0, gap, 0, h};
Point(12) = {a, gap, 0, h};
Point(13) = {a, gap + a / 2, 0, 2 * h};
Point(14) = {0, gap + a / 2, 0, 2 * h};
Line(11) = {11, 12};
Line(12) = {12, 13};
Line(13) = {13, 14};
Line(14) = {14, 11};
Curve Loop(2) = {11:14};
Plane Surface(2) = {2};
Transfinite Curve {11} = n + 1;
Transfinite Curve {5} = n + 1;

Physical Surface("base") = {1};
Physical Surface("punch") = {2};
Physical Curve("symmetry") = {6, 14};
Physical Curve("base_bottom") = {1};
Physical Curve("base_top") = {3, 4, 5};
Physical Curve("punch_bottom") = {11};
Physical Curve("punch_top") = {13};
