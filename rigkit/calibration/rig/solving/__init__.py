"""The joint least squares of cameras, mounts, targets and boards on them."""
