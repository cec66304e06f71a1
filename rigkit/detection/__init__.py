"""From an image to grids of corners: saddles, lattice, sub-pixel fit, checks, a camera's guidance."""
