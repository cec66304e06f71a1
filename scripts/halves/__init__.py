"""Parts of `split_halves.py`: captures of cameras and of rigs, halves of them, and lenses that were changed between two
halves."""
