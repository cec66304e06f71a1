"""Rigid motions, rotations, planes and triangulation: numbers only, no images, no files."""
