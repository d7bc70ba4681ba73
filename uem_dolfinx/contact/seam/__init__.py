"""What a discretisation supplies, and what its contactors are: the seam between a pair and its discretisation."""
