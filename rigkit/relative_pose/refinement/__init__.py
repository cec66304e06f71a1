"""Maximum likelihood refinement of the relative pose, and selection of the pose type."""
