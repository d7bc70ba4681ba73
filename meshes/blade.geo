// A blade whose root hangs in the slot of a disc, pulled outwards against the two shoulders of the slot; or both in one piece.
DefineConstant[
  n = 6,      // cells along a shoulder
  whole = 0   // 1 joins root and slot along the shoulders
];

neck = 0.03;  // half the width of the root between the shoulders
base = 0.045; // half its width below them
foot = 0.043; // and at its foot
high = -0.04; // height of a shoulder at the neck
low = -0.045; // and at its other end
deep = -0.12; // height of the foot
tip = 0.015;  // half the width of the blade at its tip
long = 0.4;   // height of the tip
h = Hypot(base - neck, high - low) / n;

// the blade
Point(1) = {-base, low, 0, h};
Point(2) = {base, low, 0, h};
Point(3) = {neck, high, 0, h};
Point(4) = {tip, long, 0, h};
Point(5) = {-tip, long, 0, h};
Point(6) = {-neck, high, 0, h};
Point(7) = {-foot, deep, 0, 2 * h};
Point(8) = {foot, deep, 0, 2 * h};
Line(1) = {7, 8};
Line(2) = {8, 2};
Line(3) = {2, 3};
Line(4) = {3, 4};
Line(5) = {4, 5};
Line(6) = {5, 6};
Line(7) = {6, 1};
Line(8) = {1, 7};
Curve Loop(1) = {1:8};
Plane Surface(1) = {1};

// the disc, whose shoulders are those of the root, or lie on them
q = 0;
right = 3;
left = 7;
If (whole == 0)
  q = 10;
  right = 13;
  left = 17;
  Point(11) = {-base, low, 0, h};
  Point(12) = {base, low, 0, h};
  Point(13) = {neck, high, 0, h};
  Point(16) = {-neck, high, 0, h};
  Line(right) = {12, 13};
  Line(left) = {16, 11};
EndIf
Point(21) = {-0.15, -0.25, 0, 3 * h};
Point(22) = {0.15, -0.25, 0, 3 * h};
Point(23) = {0.15, 0, 0, 3 * h};
Point(24) = {-0.15, 0, 0, 3 * h};
Point(25) = {0.04, 0, 0, h};
Point(26) = {-0.04, 0, 0, h};
Point(27) = {base, deep - 0.01, 0, 2 * h};
Point(28) = {-base, deep - 0.01, 0, 2 * h};
Line(21) = {21, 22};
Line(22) = {22, 23};
Line(23) = {23, 25};
Line(24) = {25, q + 3};
Line(25) = {q + 2, 27};
Line(26) = {27, 28};
Line(27) = {28, q + 1};
Line(28) = {q + 6, 26};
Line(29) = {26, 24};
Line(30) = {24, 21};
Curve Loop(2) = {21:24, -right, 25:27, -left, 28:30};
Plane Surface(2) = {2};
Transfinite Curve {3, 7, right, left} = n + 1;
If (whole == 0)
  Physical Curve("slot") = {right, left};
  Physical Curve("root") = {3, 7};
EndIf
Physical Surface("blade") = {1};
Physical Surface("disc") = {2};
Physical Curve("hub") = {21};
