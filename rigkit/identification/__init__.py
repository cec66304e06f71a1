"""Which board is which, and which of its corners is the first."""
