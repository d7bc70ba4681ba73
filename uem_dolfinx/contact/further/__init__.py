"""Further parts of a contact: nodes at corners of its target, and edges that cross."""
