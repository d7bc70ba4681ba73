// Equal bars of quadrilaterals in a row along x, each a body of its own.
DefineConstant[
  bars = 5,     // their number
  L = 1,        // length
  width = 0.1,
  gap = 0.02,   // between them
  n = 100       // cells along a bar
];

ends() = {};
For k In {0 : bars - 1}
  p = newp;
  Point(p) = {k * (L + gap), -width / 2, 0};
  side[] = Extrude {0, width, 0} { Point{p}; Layers{1}; };
  bar[] = Extrude {L, 0, 0} { Line{side[1]}; Layers{n}; Recombine; };
  ends() += {side[1], bar[0]};
  Physical Surface(Sprintf("bar_%g", k + 1)) = {bar[1]};
EndFor
Physical Curve("ends") = {ends()};
