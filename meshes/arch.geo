// Half of a shallow arch of thickness t, clamped at x = L/2, whose middle line is y = e/2 (1 + cos(2 pi x / L)).
DefineConstant[
  L = 200,  // span
  e = 2,    // rise
  t = 1,    // thickness
  n = 40    // cells along the half
];

k = 2 * Pi / L;
// the middle line by points of a spline, and its copies a half of the thickness off it
For i In {0:n}
  x = 0.5 * L * i / n;
  y = 0.5 * e * (1 + Cos(k * x));
  slope = -0.5 * e * k * Sin(k * x);
  s = Sqrt(1 + slope * slope);
  Point(1000 + i) = {x + 0.5 * t * slope / s, y - 0.5 * t / s, 0};
  Point(2000 + i) = {x - 0.5 * t * slope / s, y + 0.5 * t / s, 0};
EndFor
Spline(1) = {1000 : 1000 + n};
Line(2) = {1000 + n, 2000 + n};
Spline(3) = {2000 + n : 2000 : -1};
Line(4) = {2000, 1000};
Curve Loop(1) = {1 : 4};
Plane Surface(1) = {1};
Transfinite Curve {1, 3} = n + 1;
Transfinite Curve {2, 4} = 2;
Transfinite Surface {1};
Recombine Surface {1};

Physical Surface("arch") = {1};
Physical Curve("below") = {1};
Physical Curve("clamped") = {2};
Physical Curve("middle") = {4};
