"""Epipolar geometry from points and affinities, one solver a file."""
