"""Synthetic scenes with exact truth: geometry, noise and rendered images."""
