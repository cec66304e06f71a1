"""Views of boards as the calibration takes them: what can be used, as arrays, and what must be left out together."""
