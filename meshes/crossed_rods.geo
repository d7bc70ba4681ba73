// Two rods of square section that cross, each a body of its own: the second one lies on the first, which is along x. They touch in the
// plane z = 0. With an even number of cells along a rod it has nodes above or below the middle of the other one.
SetFactory("OpenCASCADE");
DefineConstant[
  length = 24,     // of the rods
  side = 1,        // of their sections
  n_1 = 48,        // cells along the first rod
  n_2 = 48,        // cells along the second rod
  m = 2,           // cells along a side of a section
  on_edge = 1,     // 1: sections stand on a corner, so that edges cross; 0: they lie on a face
  angle = Pi / 2   // between the rods
];

n() = {n_1, n_2};
half = on_edge ? side / Sqrt(2) : side / 2;
For k In {1 : 2}
  Box(k) = {-length / 2, -side / 2, -side / 2, length, side, side};
  Rotate {{1, 0, 0}, {0, 0, 0}, on_edge * Pi / 4} { Volume{k}; }
  Rotate {{0, 0, 1}, {0, 0, 0}, (k - 1) * angle} { Volume{k}; }
  Translate {0, 0, (2 * k - 3) * half} { Volume{k}; }
  // the first two faces are the ends
  face() = Abs(Boundary { Volume{k}; });
  edge() = Abs(Boundary { Surface{face()}; });
  Transfinite Curve {edge()} = n(k - 1) + 1;
  across() = Abs(Boundary { Surface{face(0), face(1)}; });
  Transfinite Curve {across()} = m + 1;
  Transfinite Surface {face()};
  Recombine Surface {face()};
  Transfinite Volume {k};
  Physical Volume(Sprintf("rod %g", k)) = {k};
  Physical Surface(Sprintf("ends %g", k)) = {face(0), face(1)};
EndFor
