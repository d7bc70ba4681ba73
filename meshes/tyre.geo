// Half the width of a solid tyre with two grooves, of hexahedra: axis y through the origin, road below, middle plane y = 0.
DefineConstant[
  n = 1,        // multiple of the number of cells in every direction
  order = 1     // degree of the geometry
];
inner = 0.1;                                   // radii of the rim, of the grooves' ground and of the tread
ground = 0.17;
outer = 0.2;
y[] = {0, 0.022, 0.03, 0.052, 0.06, 0.085};    // block, groove, block, groove, shoulder
across[] = {4, 2, 4, 2, 4};                    // cells of each
patch = 0.5;                                   // half angle of the finer sector at the road
r[] = {inner, ground, outer};
up[] = {8, 4};

// a section from the rim to the tread that looks upwards, at the top of the wheel
For k In {0 : 2}
  For i In {0 : 5}
    Point(10 * k + i + 1) = {0, y[i], r[k]};
  EndFor
EndFor
For k In {0 : 2}
  For i In {0 : 4}
    Line(100 + 10 * k + i) = {10 * k + i + 1, 10 * k + i + 2};
    Transfinite Curve {100 + 10 * k + i} = Round(n * across[i]) + 1;
  EndFor
EndFor
For k In {0 : 1}
  For i In {0 : 5}
    Line(200 + 10 * k + i) = {10 * k + i + 1, 10 * k + i + 11};
    Transfinite Curve {200 + 10 * k + i} = Round(n * up[k]) + 1;
  EndFor
  For i In {0 : 4}
    If (k == 0 || i % 2 == 0)
      s = 300 + 10 * k + i;
      Curve Loop(s) = {100 + 10 * k + i, 200 + 10 * k + i + 1, -(110 + 10 * k + i), -(200 + 10 * k + i)};
      Plane Surface(s) = {s};
      Transfinite Surface {s};
      Recombine Surface {s};
      section[] += s;
    EndIf
  EndFor
EndFor

// around the axis: from the top to the finer sector, through it, and back to the top
angle[] = {Pi / 2, Pi / 2 - patch, patch, patch, Pi / 2 - patch, Pi / 2};
along[] = {10, 14, 20, 20, 14, 10};
front[] = section[];
For turn In {0 : 5}
  next[] = {};
  For j In {0 : #front[] - 1}
    out[] = Extrude { {0, 1, 0}, {0, 0, 0}, angle[turn] } { Surface{front[j]}; Layers{Round(n * along[turn])}; Recombine; };
    next[] += out[0];
    tyre[] += out[1];
    If (j < 5)
      rim[] += out[2];
    EndIf
    If (j >= 5)
      tread[] += out[4];
    EndIf
    If (j == 0 || j == 5)
      middle[] += out[5];
    EndIf
  EndFor
  front[] = next[];
EndFor
Coherence;
Physical Volume("tyre") = {tyre[]};
Physical Surface("rim") = {rim[]};
Physical Surface("tread") = {tread[]};
Physical Surface("middle") = {middle[]};
