"""Other programs that calibrate cameras or read their files, for the benchmarks of calibration and `round_trips.py`."""
