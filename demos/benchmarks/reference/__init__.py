"""A set of contact problems with references, and what compares with them."""
