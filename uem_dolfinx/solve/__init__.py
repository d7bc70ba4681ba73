"""The united Newton loop, and problems led through load steps and time steps."""
