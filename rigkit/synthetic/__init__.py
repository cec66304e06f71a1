"""Scenes with known truth: geometry, noise, rendered images, studies."""
