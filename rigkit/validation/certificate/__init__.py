"""Bound the error of a measurement with a calibrated camera or rig over the image."""
