"""Laws of materials: elastic ones in UFL, von Mises plasticity at quadrature points."""
