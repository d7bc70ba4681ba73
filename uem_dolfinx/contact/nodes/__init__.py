"""The node-to-surface discretisation, with Bernstein points for quadratic cells and corners of targets."""
