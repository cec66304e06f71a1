"""Foreign conventions, each tool in a leaf of its own."""
