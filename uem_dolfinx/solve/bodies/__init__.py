"""The bodies without contact: residual, tangent, norms."""
