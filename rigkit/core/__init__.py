"""What every part speaks of: errors, arrays, boards, detections, matches, clouds, measured truth, processes."""
