// Right half of a block [0, width] x [-width, 0] under a flat punch of half width a, with cells of one size.
DefineConstant[
  a = 1,         // half width of the punch
  width = 4,     // of half the block, and its depth
  h = 0.5,       // size of all cells
  quads = 0      // 1: quadrilaterals
];
Point(1) = {0, 0, 0, h};
Point(2) = {a, 0, 0, h};
Point(3) = {width, 0, 0, h};
Point(4) = {width, -width, 0, h};
Point(5) = {0, -width, 0, h};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 5};
Line(5) = {5, 1};
Curve Loop(1) = {1:5};
Plane Surface(1) = {1};
If (quads)
  Recombine Surface {1};
  Mesh.SubdivisionAlgorithm = 1;
EndIf

Physical Surface("block") = {1};
Physical Curve("under_punch") = {1};
Physical Curve("bottom") = {4};
Physical Curve("symmetry") = {5};
