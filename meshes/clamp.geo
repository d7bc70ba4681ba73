// A ring with a slot at its right, whose lips are flat and parallel; the lower half mirrors the upper one, if there is one.
DefineConstant[
  r = 0.7,    // inner radius
  R = 1,      // outer radius
  slot = 0.1, // width of the slot
  n = 6,      // cells across the ring
  m = 60,     // cells along half of it
  halves = 2  // 1 is the upper half alone
];

y = slot / 2;
For k In {0:halves - 1}
  s = 1 - 2 * k;
  p = 10 * k;
  If (k == 0)
    Point(100) = {-r, 0, 0};
    Point(101) = {-R, 0, 0};
    Line(100) = {101, 100};
  EndIf
  Point(p + 1) = {Sqrt(r * r - y * y), s * y, 0};
  Point(p + 2) = {Sqrt(R * R - y * y), s * y, 0};
  Point(p + 3) = {0, s * r, 0};
  Point(p + 4) = {0, s * R, 0};
  If (k == 0)
    Point(200) = {0, 0, 0};
  EndIf
  Line(p + 1) = {p + 1, p + 2};
  Circle(p + 2) = {p + 1, 200, p + 3};
  Circle(p + 3) = {p + 3, 200, 100};
  Circle(p + 4) = {p + 2, 200, p + 4};
  Circle(p + 5) = {p + 4, 200, 101};
  Line(p + 6) = {p + 3, p + 4};
  Curve Loop(p + 1) = {p + 1, p + 4, -(p + 6), -(p + 2)};
  Curve Loop(p + 2) = {p + 6, p + 5, 100, -(p + 3)};
  Plane Surface(p + 1) = {p + 1};
  Plane Surface(p + 2) = {p + 2};
  Transfinite Curve {p + 1, p + 6} = n + 1;
  Transfinite Curve {p + 2, p + 3, p + 4, p + 5} = m / 2 + 1;
  Transfinite Surface {p + 1} = {p + 1, p + 2, p + 4, p + 3};
  Transfinite Surface {p + 2} = {p + 3, p + 4, 101, 100};
  Recombine Surface {p + 1, p + 2};
EndFor
Transfinite Curve {100} = n + 1;
If (halves == 2)
  Physical Surface("ring") = {1, 2, 11, 12};
  Physical Curve("upper") = {6};
  Physical Curve("lower") = {16};
  Physical Curve("inside") = {2, 3, 12, 13};
  Physical Curve("lips") = {1, 11};
Else
  Physical Surface("ring") = {1, 2};
  Physical Curve("upper") = {6};
  Physical Curve("inside") = {2, 3};
  Physical Curve("lips") = {1};
EndIf
Physical Curve("back") = {100};
Physical Point("root") = {101};
