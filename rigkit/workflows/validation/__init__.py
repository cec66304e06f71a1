"""Validation of data sets against measured truth, other programs and the paper."""
