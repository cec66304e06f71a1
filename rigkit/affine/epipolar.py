"""F2UDIR and F3UDIR: the affinity from directions without lengths and the epipolar geometry.

All A consistent with the epipolar geometry are A = A0 + m y^T with A0 = -n2 n1^T / |n2|^2 and m = perp(n2) / |n2|;
every direction gives one equation in y. A direction along its epipolar line, in standard stereo every board edge
parallel to the baseline, gives none.
"""

from __future__ import annotations

import numpy as np

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.components import PlanarDirections, finite, first_of, smallest_singular, unit_weights
from rigkit.core.arrays import Affines, BoolArray, FloatArray
from rigkit.core.matches import DirectionPairs


def usable_directions(
    directions: PlanarDirections, n2: FloatArray, count: int | None, min_conditioning: float
) -> BoolArray:
    """Return which directions to use, (K, n): all without a `count`, else the first `count` off the epipolar line."""
    if count is None:
        return directions.use
    across = directions.x2 * n2[0] + directions.y2 * n2[1]
    bound = min_conditioning**2 * (n2[0] * n2[0] + n2[1] * n2[1])
    square = directions.x2 * directions.x2 + directions.y2 * directions.y2
    return first_of(directions.use & (across * across >= bound * square), count)


def epipolar_block(directions: PlanarDirections, n1: FloatArray, n2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return vec(A), (4, n), and the conditioning, (n,), from all directions in use (two at least).

    Parameters
    ----------
    directions : K directions of n corners; lengths do not matter.
    n1, n2 : (2, n) epipolar normals, A^T n2 + n1 = 0.

    Notes
    -----
    Residual of direction k: perp(u2)^T A u1 with unit u1, u2 (the paper's alpha eliminated), that is
    (u2 . n2/|n2|)(u1 . y) - (u2 x n2/|n2|)(n1/|n2| . u1); least squares in y. The epipolar equations, far more precise
    than directions, are hard constraints. (Hajder stacks them with the directions; see `soft_epipolar`.)
    """
    x1, y1, x2, y2 = directions.x1, directions.y1, directions.x2, directions.y2
    w1, w2 = unit_weights(directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.sqrt(n2[0] * n2[0] + n2[1] * n2[1])
        nx, ny = n2[0] * inverse, n2[1] * inverse
        vx, vy = n1[0] * inverse, n1[1] * inverse
        c = x2 * nx + y2 * ny
        weight = w1 * w2 * c
        right = weight * (x2 * ny - y2 * nx) * (vx * x1 + vy * y1)
        weight *= c
        wx = weight * x1
        m11, m12, m22 = (wx * x1).sum(0), (wx * y1).sum(0), (weight * y1 * y1).sum(0)
        b1, b2 = (right * x1).sum(0), (right * y1).sum(0)
        determinant = 1.0 / (m11 * m22 - m12 * m12)
        p = (b1 * m22 - b2 * m12) * determinant
        q = (b2 * m11 - b1 * m12) * determinant
        a = np.stack([-nx * vx - ny * p, -nx * vy - ny * q, -ny * vx + nx * p, -ny * vy + nx * q])
    return a, smallest_singular(m11, m12, m22)


def soft_epipolar(directions: DirectionPairs, use: BoolArray, epipolar: EpipolarNormals) -> Affines:
    """Return A (N, 2, 2) from the directions in use with the epipolar equations as two more rows, as in the paper.

    Notes
    -----
    Minimises sum_k (perp(u2)^T A u1)^2 + |A^T n2 + n1|^2 / |n2|^2. Dividing by |n2| removes the arbitrary scale of F in
    the paper's rows. This exists for comparison: hard constraints give normals that are as good or better.
    """
    keep = use[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        u1 = directions.image1 / np.linalg.norm(directions.image1, axis=-1, keepdims=True)
        u2 = directions.image2 / np.linalg.norm(directions.image2, axis=-1, keepdims=True)
        length = np.linalg.norm(epipolar.n2, axis=-1, keepdims=True)
        n2_hat, v = epipolar.n2 / length, epipolar.n1 / length
    across2 = np.stack([-u2[..., 1], u2[..., 0]], axis=-1)
    rows = np.where(keep[..., None], across2[..., :, None] * u1[..., None, :], 0.0).reshape(*use.shape, 4)
    line = np.einsum("ni,jl->njil", n2_hat, np.eye(2)).reshape(-1, 2, 4)
    system = np.concatenate([rows, line], axis=1)
    right = -np.einsum("njr,nj->nr", line, v)
    normal = np.einsum("nki,nkj->nij", system, system)
    solvable = finite(normal) & (np.linalg.matrix_rank(np.nan_to_num(normal)) == 4)
    out = np.full((len(use), 2, 2), np.nan)
    out[solvable] = np.linalg.solve(normal[solvable], right[solvable, :, None]).reshape(-1, 2, 2)
    return out
