// Quarter disc (radius R, centre (0, R)) on a block [0, W] x [-W, 0], symmetric about x = 0, with cells of one size.
DefineConstant[
  h = 0.75,      // size of all cells
  R = 3,         // radius of the disc
  W = 6,         // width and height of the block
  order = 1      // of the cells: 2 follows the arc with curved ones
];
Point(1) = {0, -W, 0, h};
Point(2) = {W, -W, 0, h};
Point(3) = {W, 0, 0, h};
Point(4) = {0, 0, 0, h};
Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};
Curve Loop(1) = {1:4};
Plane Surface(1) = {1};

Point(10) = {0, R, 0, h};
Point(11) = {0, 0, 0, h};
Point(12) = {R, R, 0, h};
Circle(11) = {11, 10, 12};
Line(12) = {12, 10};
Line(13) = {10, 11};
Curve Loop(2) = {11:13};
Plane Surface(2) = {2};
Mesh.ElementOrder = order;

Physical Surface("block") = {1};
Physical Surface("disc") = {2};
Physical Curve("block_top") = {3};
Physical Curve("block_bottom") = {1};
Physical Curve("disc_arc") = {11};
Physical Curve("disc_top") = {12};
Physical Curve("symmetry") = {4, 13};
