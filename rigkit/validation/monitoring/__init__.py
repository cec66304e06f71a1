"""Monitoring: whether a calibration still holds for fresh images, given its covariance, and what changed if not."""
