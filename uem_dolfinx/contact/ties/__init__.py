"""Surfaces that are tied to each other, and preloaded sections."""
