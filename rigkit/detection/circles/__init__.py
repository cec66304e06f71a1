"""Circle grids: blobs, their lattices, the fit of circles, and the place of a lattice on a board."""
