"""Figures, drawings over images, 3D scenes, and boards to print."""
