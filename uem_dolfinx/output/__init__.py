"""What is read from a solved problem, and changes nothing in it: fields, tables, energies, pictures."""
