"""Types used by all parts: errors, arrays, boards, detections, matches, clouds, measured truth, processes."""
