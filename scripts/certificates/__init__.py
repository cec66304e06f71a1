"""The lenses of `measure_certificates.py`."""
