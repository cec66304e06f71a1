"""Fit of one camera model to all views: initial values from the views alone, then sparse bundle adjustment."""
