"""Explicit time integration: nodes with mass by central differences, massless surfaces in equilibrium with exact contact."""
