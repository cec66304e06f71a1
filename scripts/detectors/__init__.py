"""Detectors of boards behind one interface, and degradations of images, for the benchmarks of detection."""
