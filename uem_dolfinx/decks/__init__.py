"""Models of Abaqus and CalculiX, from their input files."""
