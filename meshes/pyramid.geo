// A pyramid of equal discs, each a body of its own: so many in the lowest row, one less in each row above. They are regular polygons whose
// sides touch those of the discs below, the floor y = 0, and the walls beside. No two discs that meet have equally many sides.
DefineConstant[
  base = 3,        // discs in the lowest row
  R = 0.5,         // distance of the sides from the middle
  apart = 1e-4,    // gap between discs of a row, over the diameter
  n = 24           // sides of the coarsest discs, a multiple of 24; others have 3/2 and 5/2 times as many
];

d = 2 * R * (1 + apart);
For c In {0 : 2}
  of~{c}() = {};
EndFor
For i In {0 : base - 1}
  For j In {0 : base - 1 - i}
    kind = (j - i + 3 * base) % 3;
    m = n * (kind == 0 ? 1 : (kind == 1 ? 1.5 : 2.5));
    p = newp;
    x = d * (j + i / 2);
    y = R + Sqrt(4 * R^2 - d^2 / 4) * i;
    r = R / Cos(Pi / m);
    h = 2 * Pi * R / m;
    Point(p) = {x, y, 0, h};
    c = newl;
    For k In {1 : 4}
      Point(p + k) = {x + r * Cos(Pi / 2 * (k - 1) + Pi / m), y + r * Sin(Pi / 2 * (k - 1) + Pi / m), 0, h};
    EndFor
    For k In {1 : 4}
      Circle(c + k) = {p + k, p, p + 1 + (k % 4)};
      Transfinite Curve {c + k} = m / 4 + 1;
    EndFor
    Curve Loop(c) = {c + 1, c + 2, c + 3, c + 4};
    Plane Surface(c) = {c};
    of~{kind}() += {c};
  EndFor
EndFor
Physical Surface("coarse") = {of_0()};
Physical Surface("middle") = {of_1()};
Physical Surface("fine") = {of_2()};
