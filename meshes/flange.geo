// Quarter of two pipes with flanges that four bolts join, in hexahedra: above and below z = 0 a pipe, its flange, and pads around the
// holes, on which the flanges meet; and on either plane of symmetry half of a bolt in two parts, head and nut with their shanks, which
// meet at the height "cut". No parts are glued. Numbers of cells below and above differ.
SetFactory("OpenCASCADE");
DefineConstant[
  n = 1,           // refinement: multiplies all numbers of cells
  r_i = 40,        // inner radius of the pipe
  r_p = 50,        // outer radius of the pipe
  r_c = 76,        // radius of the circle of bolts
  r_o = 100,       // outer radius of the flange
  hole = 9,        // radius of the holes
  pad = 18,        // radius of the pads
  shank = 8,       // radius of the bolts
  head = 13,       // radius of heads and nuts
  raised = 2,      // height of the pads
  t = 22,          // thickness of the flange above them
  pipe = 40,       // length of the pipe
  t_head = 10,     // height of heads and nuts
  cut = 8          // height of the bolts' sections
];
e = 1e-3;
H = raised + t;
top = H + pipe;
// cells along the arcs beside a bolt lie between the plane and this angle
beside = Pi / 10;
turn() = {0, beside, Pi / 2 - beside, Pi / 2};

// -- flanges: three blocks in the pipe's ring, one between the bolts, and four around each of them
For k In {0:1}
  s = k ? -1 : 1;
  z = s * raised;
  m() = {Round((k ? 4 : 5) * n), Round((k ? 5 : 6) * n), Round((k ? 4 : 5) * n)};
  o = newp;
  Point(o) = {0, 0, z};
  radius() = {r_i, r_p, r_o};
  For q In {0:2}
    For a In {0:3}
      Point(o + 10 + 4 * q + a) = {radius(q) * Cos(turn(a)), radius(q) * Sin(turn(a)), z};
    EndFor
  EndFor
  l = newc;
  For q In {0:2}
    For a In {0:2}
      Circle(l + 3 * q + a) = {o + 10 + 4 * q + a, o, o + 11 + 4 * q + a};
      Transfinite Curve {l + 3 * q + a} = m(a) + 1;
    EndFor
  EndFor
  For a In {0:3}
    Line(l + 10 + a) = {o + 10 + a, o + 14 + a};
    Transfinite Curve {l + 10 + a} = Round(2 * n) + 1;
  EndFor
  f = news;
  For a In {0:2}
    Curve Loop(f + a) = {l + a, l + 11 + a, -(l + 3 + a), -(l + 10 + a)};
    Plane Surface(f + a) = {f + a};
  EndFor
  // of each bolt: points outside, beside and inside it on the circles of hole and pad
  For j In {0:1}
    b = o + 30 + 10 * j;
    d = l + 20 + 20 * j;
    Point(b) = {j ? 0 : r_c, j ? r_c : 0, z};
    ring() = {hole, pad};
    For q In {0:1}
      For a In {0:2}
        u = r_c + ring(q) * Cos(a * Pi / 2);
        v = ring(q) * Sin(a * Pi / 2);
        Point(b + 1 + 3 * q + a) = {j ? v : u, j ? u : v, z};
      EndFor
      For a In {0:1}
        Circle(d + 2 * q + a) = {b + 1 + 3 * q + a, b, b + 2 + 3 * q + a};
        Transfinite Curve {d + 2 * q + a} = m(0) + 1;
      EndFor
    EndFor
    For a In {0:2}
      Line(d + 4 + a) = {b + 1 + a, b + 4 + a};
      Transfinite Curve {d + 4 + a} = Round(3 * n) + 1;
    EndFor
    // the ends of the arcs of pipe and flange, on the plane and beside the bolt
    onto() = {o + 18 + 3 * j, o + 18 + 3 * j + 1 - 2 * j, o + 14 + 3 * j + 1 - 2 * j, o + 14 + 3 * j};
    from() = {b + 4, b + 5, b + 5, b + 6};
    For a In {0:3}
      Line(d + 10 + a) = {from(a), onto(a)};
      Transfinite Curve {d + 10 + a} = Round(2 * n) + 1;
    EndFor
    g = f + 3 + 4 * j;
    way = 1 - 2 * j;
    Curve Loop(g) = {d + 10, way * (l + 6 + 2 * j), -(d + 11), -(d + 2)};
    Curve Loop(g + 1) = {d + 12, -way * (l + 3 + 2 * j), -(d + 13), -(d + 3)};
    For a In {0:1}
      Curve Loop(g + 2 + a) = {d + 4 + a, d + 2 + a, -(d + 5 + a), -(d + a)};
    EndFor
    For a In {0:3}
      Plane Surface(g + a) = {g + a};
    EndFor
  EndFor
  Curve Loop(f + 11) = {l + 4, -(l + 52), l + 51, -(l + 7), -(l + 31), l + 32};
  Plane Surface(f + 11) = {f + 11};
  Transfinite Surface {f : f + 10};
  Transfinite Surface {f + 11} = {o + 15, o + 16, o + 20, o + 19};
  Recombine Surface {f : f + 11};
  Extrude {0, 0, -z} { Surface{f + 5, f + 6, f + 9, f + 10}; Layers{1}; Recombine; }
  Extrude {0, 0, s * t} { Surface{f : f + 11}; Layers{Round(4 * n)}; Recombine; }
  ends() = Surface In BoundingBox {-e, -e, s * H - e, r_p + e, r_p + e, s * H + e};
  Extrude {0, 0, s * pipe} { Surface{ends()}; Layers{Round(5 * n)}; Recombine; }
EndFor

// -- bolts: a block in the middle of the shank, three around it, and three more in head and nut
For k In {0:1}
  s = k ? -1 : 1;
  z = s * H;
  m() = {Round((k ? 2 : 3) * n), Round((k ? 4 : 5) * n), Round((k ? 2 : 3) * n)};
  For j In {0:1}
    o = newp;
    Point(o) = {j ? 0 : r_c, j ? r_c : 0, z};
    radius() = {0.55 * shank, shank, head};
    at() = {0, Pi / 4, 3 * Pi / 4, Pi};
    For q In {0:2}
      For a In {0:3}
        u = r_c + radius(q) * Cos(at(a));
        v = radius(q) * Sin(at(a));
        Point(o + 10 + 4 * q + a) = {j ? v : u, j ? u : v, z};
      EndFor
    EndFor
    l = newc;
    For a In {0:2}
      Line(l + a) = {o + 10 + a, o + 11 + a};
      For q In {1:2}
        Circle(l + 3 * q + a) = {o + 10 + 4 * q + a, o, o + 11 + 4 * q + a};
      EndFor
      Transfinite Curve {l + a, l + 3 + a, l + 6 + a} = m(a) + 1;
    EndFor
    Line(l + 9) = {o + 13, o + 10};
    Transfinite Curve {l + 9} = m(1) + 1;
    For q In {0:1}
      For a In {0:3}
        Line(l + 10 + 4 * q + a) = {o + 10 + 4 * q + a, o + 14 + 4 * q + a};
        Transfinite Curve {l + 10 + 4 * q + a} = Round((q ? 3 : 2) * n) + 1;
      EndFor
    EndFor
    f = news;
    Curve Loop(f) = {l, l + 1, l + 2, l + 9};
    Plane Surface(f) = {f};
    For q In {0:1}
      For a In {0:2}
        Curve Loop(f + 1 + 3 * q + a) = {l + 10 + 4 * q + a, l + 3 + 3 * q + a, -(l + 11 + 4 * q + a), -(l + 3 * q + a)};
        Plane Surface(f + 1 + 3 * q + a) = {f + 1 + 3 * q + a};
      EndFor
    EndFor
    Transfinite Surface {f : f + 6};
    Recombine Surface {f : f + 6};
    Extrude {0, 0, s * t_head} { Surface{f : f + 6}; Layers{Round(3 * n)}; Recombine; }
    Extrude {0, 0, cut - z} { Surface{f : f + 3}; Layers{Round((k ? 7 : 4) * n)}; Recombine; }
  EndFor
EndFor

// -- names; where parts meet, faces lie on faces: those of one part are all that are there less the other's
all() = Volume{:};
heads() = {};
bolts() = {};
For j In {0:1}
  x = j ? 0 : r_c;
  y = j ? r_c : 0;
  bolts() += Volume In BoundingBox {x - head - e, y - head - e, -top, x + head + e, y + head + e, top};
  heads() += Volume In BoundingBox {x - head - e, y - head - e, cut - e, x + head + e, y + head + e, top};
EndFor
nuts() = bolts();
nuts() -= heads();
upper() = Volume In BoundingBox {-e, -e, -e, r_o + e, r_o + e, top + e};
upper() -= bolts();
lower() = all();
lower() -= upper();
lower() -= bolts();
of_upper() = Abs(Boundary{ Volume{upper()}; });
of_lower() = Abs(Boundary{ Volume{lower()}; });
of_heads() = Abs(Boundary{ Volume{heads()}; });
of_nuts() = Abs(Boundary{ Volume{nuts()}; });
Physical Volume("upper") = {upper()};
Physical Volume("lower") = {lower()};
Physical Volume("heads") = {heads()};
Physical Volume("nuts") = {nuts()};

upper_face() = Surface In BoundingBox {-e, -e, -e, r_o, r_o, e};
lower_face() = upper_face();
upper_face() -= of_lower();
lower_face() -= of_upper();
Physical Surface("upper_face") = {upper_face()};
Physical Surface("lower_face") = {lower_face()};

inner() = {};
For j In {0:1}
  x = j ? 0 : r_c;
  y = j ? r_c : 0;
  inner() += Surface In BoundingBox {x - shank - e, y - shank - e, -H - e, x + shank + e, y + shank + e, H + e};
  upper_section() = Surface In BoundingBox {x - head, y - head, cut - e, x + head, y + head, cut + e};
  lower_section() = upper_section();
  upper_section() -= of_nuts();
  lower_section() -= of_heads();
  Physical Surface(Sprintf("upper_section_%g", j + 1)) = {upper_section()};
  Physical Surface(Sprintf("lower_section_%g", j + 1)) = {lower_section()};
EndFor
inner() += Surface In BoundingBox {-e, -e, -H - e, r_p + e, r_p + e, H + e};
head_seat() = Surface In BoundingBox {-e, -e, H - e, r_o + e, r_o + e, H + e};
head_seat() -= inner();
under_head() = head_seat();
head_seat() -= of_heads();
under_head() -= of_upper();
nut_seat() = Surface In BoundingBox {-e, -e, -H - e, r_o + e, r_o + e, -H + e};
nut_seat() -= inner();
under_nut() = nut_seat();
nut_seat() -= of_nuts();
under_nut() -= of_lower();
Physical Surface("head_seat") = {head_seat()};
Physical Surface("under_head") = {under_head()};
Physical Surface("nut_seat") = {nut_seat()};
Physical Surface("under_nut") = {under_nut()};

Physical Surface("pipe_top") = {Surface In BoundingBox {-e, -e, top - e, r_o, r_o, top + e}};
Physical Surface("pipe_bottom") = {Surface In BoundingBox {-e, -e, -top - e, r_o, r_o, -top + e}};
Physical Surface("plane_x") = {Surface In BoundingBox {-e, -e, -top - e, e, r_o + e, top + e}};
Physical Surface("plane_y") = {Surface In BoundingBox {-e, -e, -top - e, r_o + e, e, top + e}};
