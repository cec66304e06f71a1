"""What `fuzz.py` damages, how, and what reads it."""
