"""Affine transformations from directions, and what they say of the surface."""
