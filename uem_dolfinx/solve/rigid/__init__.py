"""Rigid motions that nothing restrains, and the first touch of bodies that are free."""
