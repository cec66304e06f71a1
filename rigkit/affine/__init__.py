"""Affine transformations from directions, patches or points, and the surface normals that follow from them."""
