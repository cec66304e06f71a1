"""Tests of lattices: evidence for a board, discontinuities, borders."""
