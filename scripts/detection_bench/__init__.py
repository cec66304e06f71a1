"""Rendered scenes with exact truth, scores and Cramer-Rao bounds, for `benchmark_detection.py`, `compare_circles.py`,
`compare_tags.py` and `measure_thresholds.py`."""
