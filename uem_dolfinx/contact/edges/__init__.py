"""Contact between sharp edges that cross: one equation for each crossing, with weights at the nodes of both edges."""
