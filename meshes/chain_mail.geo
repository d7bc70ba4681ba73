// Links of a chain, rings of a round section one below the other along -z, each turned by 90 degrees from the one above, in tetrahedra.
SetFactory("OpenCASCADE");
DefineConstant[
  links = 4,     // number of links
  R = 1,         // radius of the rings
  r = 0.25,      // radius of their section
  gap = 0.02,    // between one link and the next
  held = 0.6,    // the first one is held above this height over its middle
  h = 0.2        // size of the cells
];
For k In {1:links}
  Torus(k) = {0, 0, 0, R, r};
  Rotate {{1, 0, 0}, {0, 0, 0}, Pi / 2} { Volume{k}; }
  If (k % 2 == 0)
    Rotate {{0, 0, 1}, {0, 0, 0}, Pi / 2} { Volume{k}; }
  EndIf
  Translate {0, 0, -(k - 1) * (2 * (R - r) - gap)} { Volume{k}; }
EndFor
// the first link in two parts, whose meshes fit
b = links + 1;
Box(b) = {-2 * R, -2 * R, held, 4 * R, 4 * R, 2 * R};
upper() = BooleanIntersection{ Volume{1}; }{ Volume{b}; };
lower() = BooleanDifference{ Volume{1}; Delete; }{ Volume{b}; Delete; };
first() = BooleanFragments{ Volume{upper()}; Delete; }{ Volume{lower()}; Delete; };

top() = Abs(Boundary{ Volume{first(0)}; });
top() -= Abs(Boundary{ Volume{first(1)}; });
Physical Volume("link 1") = {first()};
For k In {2:links}
  Physical Volume(Sprintf("link %g", k)) = {k};
EndFor
Physical Surface("held") = {top()};

Mesh.MeshSizeMin = h;
Mesh.MeshSizeMax = h;
