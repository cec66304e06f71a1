"""Which picture to take next: what a view would tell of the lens, before it is taken."""
