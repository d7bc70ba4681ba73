// A block of half the width upon a unit block: [0, 1]^d below and [1/4, 3/4]^(d-1) x [1, 3/2] above, d = dim.
SetFactory("OpenCASCADE");
DefineConstant[
  dim = 2,       // 2: triangles, 3: tetrahedra
  h = 0.02,      // size of the cells
  fused = 0      // 1: one body, with the nodes between the blocks shared; 0: two bodies that touch
];
e = 1e-5;

If (dim == 2)
  Rectangle(1) = {0, 0, 0, 1, 1};
  Rectangle(2) = {0.25, 1, 0, 0.5, 0.5};
  If (fused)
    BooleanFragments{ Surface{1}; Delete; }{ Surface{2}; Delete; }
  EndIf
  bottom() = Curve In BoundingBox {-e, -e, -e, 1 + e, e, e};
  top() = Curve In BoundingBox {-e, 1.5 - e, -e, 1 + e, 1.5 + e, e};
  level() = Curve In BoundingBox {-e, 1 - e, -e, 1 + e, 1 + e, e};
  upper_bottom() = Curve In BoundingBox {0.25 - e, 1 - e, -e, 0.75 + e, 1 + e, e};
  Physical Surface("blocks") = Surface{:};
  Physical Curve("bottom") = {bottom()};
  Physical Curve("top") = {top()};
Else
  Box(1) = {0, 0, 0, 1, 1, 1};
  Box(2) = {0.25, 0.25, 1, 0.5, 0.5, 0.5};
  If (fused)
    BooleanFragments{ Volume{1}; Delete; }{ Volume{2}; Delete; }
  EndIf
  bottom() = Surface In BoundingBox {-e, -e, -e, 1 + e, 1 + e, e};
  top() = Surface In BoundingBox {-e, -e, 1.5 - e, 1 + e, 1 + e, 1.5 + e};
  level() = Surface In BoundingBox {-e, -e, 1 - e, 1 + e, 1 + e, 1 + e};
  upper_bottom() = Surface In BoundingBox {0.25 - e, 0.25 - e, 1 - e, 0.75 + e, 0.75 + e, 1 + e};
  Physical Volume("blocks") = Volume{:};
  Physical Surface("bottom") = {bottom()};
  Physical Surface("top") = {top()};
EndIf

If (!fused)
  lower_top() = level();
  lower_top() -= upper_bottom();
  If (dim == 2)
    Physical Curve("lower_top") = {lower_top()};
    Physical Curve("upper_bottom") = {upper_bottom()};
  Else
    Physical Surface("lower_top") = {lower_top()};
    Physical Surface("upper_bottom") = {upper_bottom()};
  EndIf
EndIf

Mesh.MeshSizeMin = h;
Mesh.MeshSizeMax = h;
