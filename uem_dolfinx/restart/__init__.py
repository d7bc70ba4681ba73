"""Checkpoints that any number of ranks can go on from."""
