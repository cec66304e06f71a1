"""The real captures and the counts of `bench_sentinel.py`."""
