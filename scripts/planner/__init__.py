"""REAL captures for `bench_planner.py` and `bench_coach.py`."""
