"""The convention for the first corner of a lattice in a single image.

The square diagonally outside the first corner, at grid (-1..0, -1..0), is BLACK, and the board has its known size,
columns x rows (columns >= rows without a known size). This leaves one choice if columns + rows is odd, two if it is
even (the board is symmetric under rotation by 180 degrees), and up to four for square boards. Among these the one whose
columns and rows point most nearly to the right and down is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.lattice import Lattice


def quarter_turns(lattice: Lattice, sizes: Sequence[tuple[int, int]] = ()) -> int:
    """Return the quarter turns after which `lattice` follows the convention; `sizes` are the known (columns, rows)."""
    columns, rows = lattice.size
    turned = [(columns, rows), (rows, columns), (columns, rows), (rows, columns)]
    fits = [size in sizes for size in turned]
    if not any(fits):
        fits = [size[0] >= size[1] for size in turned]
    # Whether brightness rises across the +column edge of the first corner after each of the four turns.
    rising = [
        lattice.sign_at(0, 0) > 0.0,
        lattice.sign_at(rows - 1, 0) < 0.0,
        lattice.sign_at(rows - 1, columns - 1) > 0.0,
        lattice.sign_at(0, columns - 1) < 0.0,
    ]
    dark = [fit and not bright for fit, bright in zip(fits, rising, strict=True)]
    allowed = dark if any(dark) else fits
    downwards = _downwards(lattice)
    return max((q for q in range(4) if allowed[q]), key=lambda q: (downwards[q], -q))


def _downwards(lattice: Lattice) -> list[float]:
    """Return the extent of columns plus rows to the right and down after 0 to 3 quarter turns, in cells."""
    pixels = lattice.pixels
    (x1, y1), (x2, y2) = _mean(pixels[:, 1:] - pixels[:, :-1]), _mean(pixels[1:] - pixels[:-1])
    longest = max(math.hypot(x1, y1), math.hypot(x2, y2), 1e-9)
    along, down = (x1 + y1) / longest, (x2 + y2) / longest
    return [round(value, 9) for value in (along + down, along - down, -along - down, down - along)]


def _mean(steps: FloatArray) -> tuple[float, float]:
    seen = np.isfinite(steps[..., 0])
    count = max(int(np.count_nonzero(seen)), 1)
    u, v = np.add.reduce(steps[seen], axis=0)
    return float(u) / count, float(v) / count
