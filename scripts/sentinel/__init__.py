"""Real captures, scenes and statistics for `bench_sentinel.py`."""
