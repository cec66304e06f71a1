"""Which lens, which shape of the board, and which end of it is which: several are fitted, other images decide."""
