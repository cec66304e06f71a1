"""Problems, plain loops and other programs for `benchmark_core.py`."""
