"""Reconstructions against what a person measured."""
