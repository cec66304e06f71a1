"""Linear and minimal solvers of the epipolar geometry, one module per pose type; poses from essential matrices."""
