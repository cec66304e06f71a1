"""What speaks against a grid being a board: patterns, discontinuities, borders."""
