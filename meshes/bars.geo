// Bars of quadrilaterals or hexahedra along y, one above the other: one stands `gap` above y = 0, further ones `gap` above the last.
DefineConstant[
  dim = 2,
  bars = 1,       // their number, 1 or 2
  L = 10,         // length
  width = 1,
  gap = 5,
  n = 100,        // cells along a bar
  n_width = 1,    // cells across a bar
  n_upper = 0     // cells across the second bar; 0 takes n_width
];

For k In {0 : bars - 1}
  p = 10 * k + 1;
  y = gap + k * (L + gap);
  across = (k == 1 && n_upper > 0) ? n_upper : n_width;
  Point(p) = {-width / 2, y, 0};
  line[] = Extrude {width, 0, 0} { Point{p}; Layers{across}; };
  If (dim == 3)
    base[] = Extrude {0, 0, width} { Line{line[1]}; Layers{across}; Recombine; };
    bar[] = Extrude {0, L, 0} { Surface{base[1]}; Layers{n}; Recombine; };
    ends[] = {base[1], bar[0]};
  Else
    bar[] = Extrude {0, L, 0} { Line{line[1]}; Layers{n}; Recombine; };
    ends[] = {line[1], bar[0]};
  EndIf
  If (k == 0)
    lower = bar[1]; lower_ends[] = ends[];
  Else
    upper = bar[1]; upper_ends[] = ends[];
  EndIf
EndFor

If (dim == 3)
  Physical Volume("lower") = {lower};
  Physical Surface("lower_bottom") = {lower_ends[0]};
  Physical Surface("lower_top") = {lower_ends[1]};
Else
  Physical Surface("lower") = {lower};
  Physical Curve("lower_bottom") = {lower_ends[0]};
  Physical Curve("lower_top") = {lower_ends[1]};
EndIf
If (bars == 2 && dim == 3)
  Physical Volume("upper") = {upper};
  Physical Surface("upper_bottom") = {upper_ends[0]};
  Physical Surface("upper_top") = {upper_ends[1]};
EndIf
If (bars == 2 && dim == 2)
  Physical Surface("upper") = {upper};
  Physical Curve("upper_bottom") = {upper_ends[0]};
  Physical Curve("upper_top") = {upper_ends[1]};
EndIf
