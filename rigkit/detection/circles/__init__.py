"""Circle grids: blobs, lattices, the fit of circles, and which board a lattice is."""
