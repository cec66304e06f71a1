"""Detectors of boards behind one interface, and what makes an image worse, for the benchmarks of detection."""
