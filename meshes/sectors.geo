// Sectors of a disc of radius R that meet in its centre, each a body of its own: sector k lies with its last side on the first of the next.
DefineConstant[
  sectors = 3, // number of bodies, 3 or more
  R = 1,       // radius of the disc
  n = 8,       // cells along the sides of the first sector
  more = 0     // by how many cells more the sides of every further one are divided
];

angle = 2 * Pi / sectors;
For k In {1:sectors}
  p = 10 * k;
  cells = n + more * (k - 1);
  h = R / cells;
  Point(p) = {0, 0, 0, h};
  Point(p + 1) = {R * Cos(angle * (k - 1)), R * Sin(angle * (k - 1)), 0, h};
  Point(p + 2) = {R * Cos(angle * k), R * Sin(angle * k), 0, h};
  Line(p) = {p, p + 1};
  Circle(p + 1) = {p + 1, p, p + 2};
  Line(p + 2) = {p + 2, p};
  Curve Loop(p) = {p, p + 1, p + 2};
  Plane Surface(p) = {p};
  Transfinite Curve {p, p + 2} = cells + 1;
  Transfinite Curve {p + 1} = Ceil(angle * cells) + 1;
  Physical Surface(Sprintf("sector_%g", k)) = {p};
  Physical Curve(Sprintf("first_%g", k)) = {p};
  Physical Curve(Sprintf("rim_%g", k)) = {p + 1};
  Physical Curve(Sprintf("last_%g", k)) = {p + 2};
EndFor
