// Two spur gears in mesh, involute flanks, teeth of the second on the line of centres between two of the first.
DefineConstant[
  z1 = 16,          // teeth of the first gear, around the origin
  z2 = 24,          // teeth of the second, beside it along x
  m = 1.0,          // module: pitch diameter over number of teeth, a length
  pressure = 20,    // pressure angle in degrees
  backlash = 0.02,  // what teeth are thinner than spaces on the pitch circle, of the module
  hub = 0.5,        // radius of the bore over that of the roots
  h = 0.15,         // size of cells on the flanks, of the module
  n = 6             // points of a flank's spline
];
a = pressure * Pi / 180;
inv = Tan(a) - a;
lc = h * m;

Macro Gear
  // z teeth around (X, 0), the first at the angle `turn`
  rp = m * z / 2;
  rb = rp * Cos(a);
  ra = rp + m;
  rf = rp - 1.25 * m;
  // flanks begin at the base circle or the roots
  rs = rb > rf ? rb * 1.0000001 : rf;
  centre = newp;
  Point(centre) = {X, 0, 0, lc};
  half = Pi / (2 * z) - backlash / (2 * rp / m);
  outline[] = {};
  flanks[] = {};
  For t In {0:z - 1}
    middle = turn + 2 * Pi * t / z;
    lower[] = {};
    upper[] = {};
    For k In {0:n - 1}
      r = rs + (ra - rs) * k / (n - 1);
      b = Acos(rb / r);
      s = half + inv - (Tan(b) - b);
      p = newp;
      Point(p) = {X + r * Cos(middle - s), r * Sin(middle - s), 0, lc};
      lower[] += {p};
      p = newp;
      Point(p) = {X + r * Cos(middle + s), r * Sin(middle + s), 0, lc};
      upper[] = {p, upper[]};
    EndFor
    s = half + inv - (Tan(Acos(rb / rs)) - Acos(rb / rs));
    low = newp;
    Point(low) = {X + rf * Cos(middle - s), rf * Sin(middle - s), 0, lc};
    high = newp;
    Point(high) = {X + rf * Cos(middle + s), rf * Sin(middle + s), 0, lc};
    If (t > 0)
      c = newl;
      Circle(c) = {last, centre, low};
      outline[] += {c};
    Else
      first = low;
    EndIf
    last = high;
    c = newl;
    Line(c) = {low, lower[0]};
    Spline(c + 1) = {lower[]};
    Circle(c + 2) = {lower[n - 1], centre, upper[0]};
    Spline(c + 3) = {upper[]};
    Line(c + 4) = {upper[n - 1], high};
    outline[] += {c, c + 1, c + 2, c + 3, c + 4};
    flanks[] += {c + 1, c + 2, c + 3};
  EndFor
  c = newl;
  Circle(c) = {last, centre, first};
  outline[] += {c};
  bore[] = {};
  For q In {0:3}
    p = newp;
    Point(p) = {X + hub * rf * Cos(q * Pi / 2), hub * rf * Sin(q * Pi / 2), 0, 6 * lc};
    If (q == 0)
      begin = p;
    EndIf
  EndFor
  For q In {0:3}
    c = newl;
    Circle(c) = {begin + q, centre, begin + (q + 1) % 4};
    bore[] += {c};
  EndFor
  c = newll;
  Curve Loop(c) = {outline[]};
  Curve Loop(c + 1) = {bore[]};
  s = news;
  Plane Surface(s) = {c, c + 1};
Return

z = z1; X = 0; turn = 0;
Call Gear;
Physical Surface("driver") = {s};
Physical Curve("driver_flanks") = {flanks[]};
Physical Curve("driver_bore") = {bore[]};

z = z2; X = m * (z1 + z2) / 2; turn = Pi + Pi / z2;
Call Gear;
Physical Surface("driven") = {s};
Physical Curve("driven_flanks") = {flanks[]};
Physical Curve("driven_bore") = {bore[]};
