"""Sets, other programs and tables for `bench_truth.py`."""
