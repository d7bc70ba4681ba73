// A quarter of a round rod along z from z = 0, of hexahedra: three blocks around the axis.
DefineConstant[
  R = 3.2,       // radius
  L = 32.4,      // length
  n = 3,         // cells along each block's sides
  layers = 36,   // cells along the rod
  grow = 1       // length of the last layer over that of the first
];

a = 0.5 * R;
b = 0.42 * R;
c = R * Sqrt(0.5);
Point(1) = {0, 0, 0};
Point(2) = {a, 0, 0};
Point(3) = {b, b, 0};
Point(4) = {0, a, 0};
Point(5) = {R, 0, 0};
Point(6) = {c, c, 0};
Point(7) = {0, R, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {4, 3};
Line(4) = {1, 4};
Line(5) = {2, 5};
Line(6) = {3, 6};
Line(7) = {4, 7};
Circle(8) = {5, 1, 6};
Circle(9) = {7, 1, 6};
Curve Loop(1) = {1, 2, -3, -4};
Curve Loop(2) = {5, 8, -6, -2};
Curve Loop(3) = {3, 6, -9, -7};
For k In {1:9}
  Transfinite Curve {k} = n + 1;
EndFor
For k In {1:3}
  Plane Surface(k) = {k};
  Transfinite Surface {k};
  Recombine Surface {k};
EndFor
For k In {1 : layers}
  part[] += 1;
  way = 0;
  For j In {1 : k}
    way += grow^((j - 1) / (layers - 1));
  EndFor
  ends[] += way;
EndFor
For k In {0 : layers - 1}
  ends[k] = ends[k] / way;
EndFor
rod[] = Extrude {0, 0, L} { Surface{1, 2, 3}; Layers{part[], ends[]}; Recombine; };

Physical Volume("rod") = {rod[1], rod[7], rod[13]};
Physical Surface("foot") = {1:3};
Physical Surface("rear") = {rod[0], rod[6], rod[12]};
Physical Surface("on_y") = {rod[2], rod[8]};
Physical Surface("on_x") = {rod[5], rod[17]};
Physical Surface("side") = {rod[9], rod[16]};
