"""Parts of `path_traced.py`, which renders captures with Blender's Cycles, and of `measure_traced.py`, which measures
rigkit on them: lenses and captures as numbers (no Blender needed), and what Blender makes of them."""
