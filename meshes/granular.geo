// Rows of discs one above the other, each a body of its own; every second row is shifted by half of the distance between them.
DefineConstant[
  rows = 3,     // number of rows
  columns = 3,  // discs in a row
  R = 0.5,      // radius
  apart = 1.15, // distance between their middles over the diameter
  n = 24        // facets around each
];

d = 2 * R * apart;
h = 2 * Pi * R / n;
discs() = {};
rims() = {};
For i In {0:rows - 1}
  For j In {0:columns - 1}
    p = 10 * (i * columns + j) + 1;
    x = d * (j + (i % 2) / 2);
    y = R + d * i;
    Point(p) = {x, y, 0, h};
    For k In {1:4}
      Point(p + k) = {x + R * Cos(Pi / 2 * (k - 1)), y + R * Sin(Pi / 2 * (k - 1)), 0, h};
    EndFor
    For k In {1:4}
      Circle(p + k) = {p + k, p, p + 1 + (k % 4)};
      Transfinite Curve {p + k} = n / 4 + 1;
    EndFor
    Curve Loop(p) = {p + 1, p + 2, p + 3, p + 4};
    Plane Surface(p) = {p};
    discs() += {p};
    rims() += {p + 1, p + 2, p + 3, p + 4};
  EndFor
EndFor
Physical Surface("discs") = {discs()};
Physical Curve("rims") = {rims()};
