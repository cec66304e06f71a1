"""Data sets against what a person measured, against other programs and against the paper."""
