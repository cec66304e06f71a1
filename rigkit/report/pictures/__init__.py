"""Figures, drawings over images, scenes in perspective, and boards to print."""
