"""The linearised frictional problem in relative motions, as a problem of arrays."""
