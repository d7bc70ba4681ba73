// Unit cube [0, 1]^2 x [-1, 0] of N x N x N/2 hexahedra.
DefineConstant[ N = 30 ];

Point(1) = {0, 0, -1};
Extrude {1, 0, 0} { Point{1}; Layers{N}; Recombine; }
Extrude {0, 1, 0} { Curve{1}; Layers{N}; Recombine; }
cube[] = Extrude {0, 0, 1} { Surface{5}; Layers{N / 2}; Recombine; };

// the sides follow in the order of the base's curves: y = 0, x = 1, y = 1, x = 0
Physical Volume("body") = {cube[1]};
Physical Surface("bottom") = {5};
Physical Surface("top") = {cube[0]};
Physical Surface("side_y0") = {cube[2]};
Physical Surface("side_x1") = {cube[3]};
Physical Surface("side_y1") = {cube[4]};
Physical Surface("side_x0") = {cube[5]};
