"""Sub-pixel positions of corners and their standard deviations, by fits of an edge model."""
