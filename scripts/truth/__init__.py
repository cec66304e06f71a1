"""The sets, the peers and the tables of `bench_truth.py`."""
