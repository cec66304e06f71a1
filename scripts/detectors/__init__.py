"""Detectors of boards behind one interface, and degradations of images, for `compare_detection.py` and the other
scripts that measure detection."""
