"""Load steps, time steps, stages and arc length."""
