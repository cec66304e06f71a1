"""Real captures, scenes and statistics for `bench_check.py`."""
