// Cover of an instrument: a rectangular plate with walls all round and a rib across its middle, in hexahedra.
// a, b: sides; c: height of the walls; t: thickness; h: size of cells along the walls; n: cells through the thickness.
DefineConstant[ a = 60, b = 40, c = 12, t = 2, h = 2, n = 1 ];
x[] = {0, t, (a - t) / 2, (a + t) / 2, a - t, a};
y[] = {0, t, b - t, b};
For j In {0:3}
  For i In {0:5}
    p = newp; Point(p) = {x[i], y[j], 0}; points[6 * j + i] = p;
  EndFor
EndFor
For j In {0:3}
  For i In {0:4}
    l = newl; Line(l) = {points[6 * j + i], points[6 * j + i + 1]}; along[5 * j + i] = l;
    d = x[i + 1] - x[i];
    Transfinite Curve {l} = 1 + ((d < 1.5 * t) ? n : Max(1, Round(d / h)));
  EndFor
EndFor
For j In {0:2}
  For i In {0:5}
    l = newl; Line(l) = {points[6 * j + i], points[6 * (j + 1) + i]}; across[6 * j + i] = l;
    d = y[j + 1] - y[j];
    Transfinite Curve {l} = 1 + ((d < 1.5 * t) ? n : Max(1, Round(d / h)));
  EndFor
EndFor
For j In {0:2}
  For i In {0:4}
    s = news; Curve Loop(s) = {along[5 * j + i], across[6 * j + i + 1], -along[5 * (j + 1) + i], -across[6 * j + i]};
    Plane Surface(s) = {s}; Transfinite Surface {s}; Recombine Surface {s};
    plate[] = Extrude {0, 0, t} { Surface{s}; Layers{n}; Recombine; };
    volumes[] += {plate[1]};
    // walls, and the rib in the middle
    If (j == 0 || j == 2 || i == 0 || i == 2 || i == 4)
      wall[] = Extrude {0, 0, c - t} { Surface{plate[0]}; Layers{Max(1, Round((c - t) / h))}; Recombine; };
      volumes[] += {wall[1]};
    EndIf
  EndFor
EndFor
Coherence;
Physical Volume("cover") = {volumes[]};
Physical Surface("surface") = {CombinedBoundary{ Volume{volumes[]}; }};
