"""Where a corner is, and how well that is known: the fit of two edges to the pixels around it."""
