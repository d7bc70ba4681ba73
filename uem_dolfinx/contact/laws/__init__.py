"""Laws of contact as functions of arrays, without mesh and without communication."""
