"""What a board's pose or a calibrated camera adds: missed corners, parts of one board, covered ones."""
