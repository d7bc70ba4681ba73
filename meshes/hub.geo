// A hollow shaft (radii a and b) in a hub (radii b and c): two rings that touch along the circle of radius b.
DefineConstant[
  a = 10,        // inner radius of the shaft
  b = 20,        // radius of the interface
  c = 40,        // outer radius of the hub
  n_shaft = 48,  // cells of the shaft around, a multiple of 4
  n_hub = 40,    // cells of the hub around, a multiple of 4
  layers = 4,    // cells through the wall of the shaft; the hub has twice as many
  order = 2      // degree of the geometry: 2 has cells with curved sides
];
inner() = {a, b};
outer() = {b, c};
around() = {n_shaft, n_hub};

For k In {0:1}
  s = 100 * k;
  Point(s + 50) = {0, 0, 0};
  For q In {0:3}
    turn = q * Pi / 2;
    Point(s + q + 1) = {inner(k) * Cos(turn), inner(k) * Sin(turn), 0};
    Point(s + q + 11) = {outer(k) * Cos(turn), outer(k) * Sin(turn), 0};
    Line(s + q + 21) = {s + q + 1, s + q + 11};
  EndFor
  For q In {0:3}
    next = (q + 1) % 4;
    Circle(s + q + 1) = {s + q + 1, s + 50, s + next + 1};
    Circle(s + q + 11) = {s + q + 11, s + 50, s + next + 11};
    Curve Loop(s + q + 1) = {s + q + 21, s + q + 11, -(s + next + 21), -(s + q + 1)};
    Plane Surface(s + q + 1) = {s + q + 1};
    Transfinite Curve {s + q + 1, s + q + 11} = around(k) / 4 + 1;
    Transfinite Curve {s + q + 21} = (k + 1) * layers + 1;
  EndFor
  For q In {0:3}
    next = (q + 1) % 4;
    Transfinite Surface {s + q + 1} = {s + q + 1, s + q + 11, s + next + 11, s + next + 1};
    Recombine Surface {s + q + 1};
  EndFor
EndFor

Physical Surface("shaft") = {1:4};
Physical Surface("hub") = {101:104};
Physical Curve("hole") = {1:4};
Physical Curve("seat") = {11:14};
Physical Curve("bore") = {101:104};
Physical Curve("outside") = {111:114};
Mesh.ElementOrder = order;
