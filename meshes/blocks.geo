// Two or three unit blocks on each other, the lowest one on [0, 1]^dim; all cells are right-angled and alike.
//
// Numbers of cells that divide each other make nested meshes: the nodes of the finer side contain those of the coarser.
SetFactory("OpenCASCADE");
DefineConstant[
  dim = 2,       // 2 or 3
  n_1 = 4,       // cells along each side of the lowest block
  n_2 = 8,       // cells along each side of the second block
  n_3 = 0,       // cells along each side of the third block; 0: there are two blocks
  quads = 0,     // 1: quadrilaterals and hexahedra instead of triangles and tetrahedra
  order = 1      // degree of the geometry
];
n() = {n_1, n_2, n_3};
sides_x() = {};
sides_y() = {};

For k In {1 : n_3 ? 3 : 2}
  If (dim == 2)
    // its sides are the bottom, x = 1, the top and x = 0
    Rectangle(k) = {0, k - 1, 0, 1, 1};
    side() = Boundary { Surface{k}; };
    Transfinite Curve {side()} = n(k - 1) + 1;
    Transfinite Surface {k};
    Physical Surface(Sprintf("block_%g", k)) = {k};
    Physical Curve(Sprintf("bottom_%g", k)) = {side(0)};
    Physical Curve(Sprintf("top_%g", k)) = {side(2)};
    sides_x() += {side(1), side(3)};
  Else
    // its sides are x = 0, x = 1, y = 0, y = 1, the bottom and the top
    Box(k) = {0, 0, k - 1, 1, 1, 1};
    side() = Abs(Boundary { Volume{k}; });
    edge() = Abs(Boundary { Surface{side()}; });
    Transfinite Curve {edge()} = n(k - 1) + 1;
    Transfinite Surface {side()};
    Transfinite Volume {k};
    Physical Volume(Sprintf("block_%g", k)) = {k};
    Physical Surface(Sprintf("bottom_%g", k)) = {side(4)};
    Physical Surface(Sprintf("top_%g", k)) = {side(5)};
    sides_x() += {side(0), side(1)};
    sides_y() += {side(2), side(3)};
  EndIf
EndFor

If (dim == 2)
  Physical Curve("sides_x") = {sides_x()};
Else
  Physical Surface("sides_x") = {sides_x()};
  Physical Surface("sides_y") = {sides_y()};
EndIf
If (quads)
  Recombine Surface {:};
EndIf
Mesh.ElementOrder = order;
