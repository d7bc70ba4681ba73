"""The united Newton loop, and problems solved in load steps and time steps."""
