"""The problems, the plain loops and the peers of `benchmark_core.py`."""
