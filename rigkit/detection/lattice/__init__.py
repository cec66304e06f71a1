"""Lattices from loose corners: links, growth, splitting and joining."""
