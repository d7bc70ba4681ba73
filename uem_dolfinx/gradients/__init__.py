"""Derivatives of results by parameters: adjoints of states and of histories."""
