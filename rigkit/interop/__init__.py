"""File formats and conventions of other programs, one module each."""
