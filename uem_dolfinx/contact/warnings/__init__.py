"""Checks and warnings of contacts after steps."""
