"""Refinement of detections with known boards or calibrated cameras: missed corners, joining of parts, shadows."""
