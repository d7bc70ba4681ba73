"""What is read from a solved problem: fields, tables, energies, pictures."""
