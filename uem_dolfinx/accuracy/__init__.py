"""Errors of discretisation: estimates, and meshes that follow them."""
