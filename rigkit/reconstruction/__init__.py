"""From two images' corners or correspondences to an oriented cloud in millimetres."""
