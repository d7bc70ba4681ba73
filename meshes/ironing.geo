// A slab [0, L] x [-H, 0] and above it a tool whose tip, of radius R, touches it at x = start.
//
// The third dimension is half of a slab of half width W under a tool with a ball's tip, symmetric about y = 0; z is then upward.
// Both bodies are meshed in rows of quadrilaterals or hexahedra, so that the slab looks the same from one element to the next.
DefineConstant[
  dim = 2,        // 2: quadrilaterals, 3: hexahedra
  n = 30,         // elements along the slab, L / n is their pitch
  layers = 5,     // elements through the slab's height
  n_tip = 24,     // elements along the tool's tip
  tool = 1,       // 0: the slab alone, for a rigid tool
  L = 3,          // length of the slab
  H = 0.5,        // its height
  W = 0.6,        // half its width
  R = 0.5,        // radius of the tip
  B = 0.3,        // half the width of the tool, in 3D less than R / Sqrt(2)
  start = 0.5     // the tool's middle
];
rows = Ceil(W / L * n);          // across the slab's half width
rows_tip = Ceil(n_tip / 2);      // across half of the tool
layers_tool = Ceil(n_tip / 4);   // through its height
up = dim == 3 ? 1 : 0;

// drawn in the plane, and in 3D turned upright
Point(1) = {0, -H, 0};
Point(2) = {L, -H, 0};
Point(3) = {L, 0, 0};
Point(4) = {0, 0, 0};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};
Transfinite Curve {1, 3} = n + 1;
Transfinite Curve {2, 4} = layers + 1;
Transfinite Surface {1};
Recombine Surface {1};
If (dim == 3)
  Rotate {{1, 0, 0}, {0, 0, 0}, Pi / 2} { Surface{1}; }
  slab[] = Extrude {0, W, 0} { Surface{1}; Layers{rows}; Recombine; };
EndIf

If (tool)
  // the corners of the tip lie at height y, in 3D those away from the symmetry plane higher than those in it
  For k In {0:up}
    p = 100 + 20 * k;
    b = k * B;
    r = Sqrt(R^2 - b^2);
    y = R - Sqrt(r^2 - B^2);
    Point(p) = {start, up ? b : R, up ? R : 0};
    Point(p + 1) = {start - B, up ? b : y, up ? y : 0};
    Point(p + 2) = {start + B, up ? b : y, up ? y : 0};
    Point(p + 3) = {start + B, up ? b : R, up ? R : 0};
    Point(p + 4) = {start - B, up ? b : R, up ? R : 0};
    Circle(p + 1) = {p + 1, p, p + 2};
    Line(p + 2) = {p + 2, p + 3};
    Line(p + 3) = {p + 3, p + 4};
    Line(p + 4) = {p + 4, p + 1};
    Curve Loop(p) = {p + 1 : p + 4};
    Plane Surface(p) = {p};
    Transfinite Curve {p + 1, p + 3} = n_tip + 1;
    Transfinite Curve {p + 2, p + 4} = layers_tool + 1;
    Transfinite Surface {p};
    Recombine Surface {p};
  EndFor
  If (dim == 3)
    // through the corners away from the symmetry plane: arcs about the ball's middle in planes x = constant
    Point(140) = {start - B, 0, R};
    Point(141) = {start + B, 0, R};
    Circle(141) = {101, 140, 121};
    Circle(142) = {102, 141, 122};
    Line(143) = {103, 123};
    Line(144) = {104, 124};
    Transfinite Curve {141:144} = rows_tip + 1;
    Curve Loop(141) = {101, 142, -121, -141};
    Surface(141) = {141} In Sphere {100};
    Curve Loop(142) = {102, 143, -122, -142};
    Plane Surface(142) = {142};
    Curve Loop(143) = {103, 144, -123, -143};
    Plane Surface(143) = {143};
    Curve Loop(144) = {104, 141, -124, -144};
    Plane Surface(144) = {144};
    Transfinite Surface {141:144};
    Recombine Surface {141:144};
    Surface Loop(1) = {100, 120, 141:144};
    Volume(100) = {1};
    Transfinite Volume {100};
  EndIf
EndIf

If (dim == 2)
  Physical Surface("slab") = {1};
  Physical Curve("slab_bottom") = {1};
  Physical Curve("slab_top") = {3};
  If (tool)
    Physical Surface("tool") = {100};
    Physical Curve("tool_tip") = {101};
    Physical Curve("tool_top") = {103};
  EndIf
Else
  Physical Volume("slab") = {slab[1]};
  Physical Surface("slab_bottom") = {slab[2]};
  Physical Surface("slab_top") = {slab[4]};
  If (tool)
    Physical Volume("tool") = {100};
    Physical Surface("tool_tip") = {141};
    Physical Surface("tool_top") = {143};
    Physical Surface("symmetry") = {1, 100};
  Else
    Physical Surface("symmetry") = {1};
  EndIf
EndIf
