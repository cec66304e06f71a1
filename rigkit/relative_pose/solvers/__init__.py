"""Linear and minimal solvers of the epipolar geometry, one file a pose type, and the pose in an essential matrix."""
