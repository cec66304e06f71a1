"""Inputs, mutations and readers of `fuzz.py`."""
