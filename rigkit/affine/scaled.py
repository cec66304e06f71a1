"""2SDIR and 3SDIR: the affinity from directions with lengths, by linear least squares. No epipolar geometry."""

from __future__ import annotations

import numpy as np

from rigkit.affine.components import PlanarDirections, smallest_singular, unit_weights
from rigkit.core.arrays import FloatArray


def scaled_block(directions: PlanarDirections) -> tuple[FloatArray, FloatArray]:
    """Return vec(A), (4, n), and the conditioning, (n,), from all directions in use (two at least).

    Notes
    -----
    A = D2 D1^T (D1 D1^T)^-1 with the direction vectors in columns (Hajder, 2SDIR and 3SDIR); with two directions it is
    D2 D1^-1. Exactly covariant under linear changes of the pixel coordinates of either image.
    """
    x1, y1, x2, y2 = directions.x1, directions.y1, directions.x2, directions.y2
    m11, m12, m22 = (x1 * x1).sum(0), (x1 * y1).sum(0), (y1 * y1).sum(0)
    b11, b12 = (x2 * x1).sum(0), (x2 * y1).sum(0)
    b21, b22 = (y2 * x1).sum(0), (y2 * y1).sum(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (m11 * m22 - m12 * m12)
        a = np.stack(
            [
                (b11 * m22 - b12 * m12) * inverse,
                (b12 * m11 - b11 * m12) * inverse,
                (b21 * m22 - b22 * m12) * inverse,
                (b22 * m11 - b21 * m12) * inverse,
            ]
        )
    w1, _ = unit_weights(directions)
    return a, smallest_singular((w1 * x1 * x1).sum(0), (w1 * x1 * y1).sum(0), (w1 * y1 * y1).sum(0))
