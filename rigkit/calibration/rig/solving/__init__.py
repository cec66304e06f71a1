"""All cameras, mounts, targets and places by one least squares."""
