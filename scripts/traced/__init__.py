"""Modules of `path_traced.py`, which renders captures with Blender's Cycles, and of `measure_traced.py`, which measures
rigkit on them: definitions of lenses and captures (without Blender), and their rendering."""
