"""The small sessions of `measure_honesty.py`."""
