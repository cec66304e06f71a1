"""Affinities from any mix of directions with and without lengths, with and without epipolar geometry.

The estimators of the registry are the pure cases: lengths of all directions (2SDIR, 3SDIR), or of none together with
the epipolar geometry (F2UDIR, F3UDIR).
"""

from __future__ import annotations

import numpy as np

from rigkit.affine.affinities import Affinities, DirectionNoise, EpipolarNormals, propagated
from rigkit.affine.components import MIN_CONDITIONING, finite
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs

SINGULAR = 1e-6
"""Smallest singular value at which normal equations are still solvable in double precision."""


def affines_from_mixed_directions(
    directions: DirectionPairs,
    scaled: BoolArray,
    *,
    epipolar: EpipolarNormals | None = None,
    noise: DirectionNoise | None = None,
    min_conditioning: float = MIN_CONDITIONING,
) -> Affinities:
    """Return the affinities of N corners by least squares over all valid directions.

    Raises InputError: shapes that do not fit.

    Parameters
    ----------
    directions : N corners, K directions each.
    scaled : bool, broadcast to (N, K): whether the length of a direction is used. A direction with length gives two
        equations, one without gives one. Four are needed, including a length; two with epipolar geometry.
    epipolar : hard constraint A^T n2 + n1 = 0; None: no constraint.
    noise : of the directions, for covariances of the affinities.
    min_conditioning : smallest singular value of the system of a valid affinity.

    Notes
    -----
    Rows in unit directions: perp(u2)^T A u1 = 0, and u2^T A u1 = |d2| / |d1| where the length is used. Both angles and
    relative lengths are dimensionless and get equal weights.
    """
    counts = _checked(directions.valid.shape, scaled, epipolar)
    A21, conditioning = _solved(directions, counts, epipolar)
    valid = finite(A21) & (conditioning >= min_conditioning)
    A21[~valid] = np.nan
    covariance = None
    if noise is not None:
        covariance = propagated(lambda moved: _solved(moved, counts, epipolar)[0], directions, noise)
        covariance[~valid] = np.nan
    return Affinities(A21, valid, conditioning, covariance)


def _solved(
    directions: DirectionPairs, counts: BoolArray, epipolar: EpipolarNormals | None
) -> tuple[FloatArray, FloatArray]:
    """Return the affinities (N, 2, 2), and the smallest singular values (N,) of their systems."""
    n, k = directions.valid.shape
    length1, length2 = (np.linalg.norm(d, axis=-1) for d in (directions.image1, directions.image2))
    use = directions.valid & (length1 > 0.0) & (length2 > 0.0)
    length1, length2 = np.where(use, length1, 1.0), np.where(use, length2, 1.0)
    u1 = np.where(use[..., None], directions.image1, 0.0) / length1[..., None]
    u2 = np.where(use[..., None], directions.image2, 0.0) / length2[..., None]
    weight = np.stack([use, use & counts], axis=-1).astype(np.float64)
    left = np.stack([np.stack([-u2[..., 1], u2[..., 0]], axis=-1), u2], axis=-2)  # (N, K, 2 rows, 2)
    rows = (weight[..., None, None] * left[..., :, None] * u1[:, :, None, None, :]).reshape(n, 2 * k, 4)
    right = np.zeros((n, k, 2))
    right[..., 1] = weight[..., 1] * length2 / length1
    base, free = _unknowns(n, epipolar)
    a, conditioning = _least_squares(rows @ free, right.reshape(n, 2 * k) - np.einsum("nrj,nj->nr", rows, base))
    return (base + np.einsum("nij,nj->ni", free, a)).reshape(n, 2, 2), conditioning


def _checked(shape: tuple[int, ...], scaled: BoolArray, epipolar: EpipolarNormals | None) -> BoolArray:
    """Return `scaled` as (N, K). Raises InputError if its shape or that of the epipolar normals does not fit."""
    n, k = shape
    if epipolar is not None and len(epipolar) != n:
        raise InputError(f"mixed directions: {n} corners but epipolar normals of {len(epipolar)}")
    try:
        if np.asarray(scaled).dtype != np.bool_:
            raise InputError(f"mixed directions: scaled must be truth values, got {np.asarray(scaled).dtype}")
        return np.broadcast_to(scaled, (n, k))
    except ValueError as error:
        raise InputError(f"mixed directions: scaled must broadcast to {n}x{k}, got {np.shape(scaled)}") from error


def _unknowns(n: int, epipolar: EpipolarNormals | None) -> tuple[FloatArray, FloatArray]:
    """Return offset (N, 4) and basis (N, 4, U) of all affinities, or of those with the epipolar constraint."""
    if epipolar is None:
        return np.zeros((n, 4)), np.broadcast_to(np.eye(4), (n, 4, 4))
    with np.errstate(divide="ignore", invalid="ignore"):
        n2, n1 = (v / np.linalg.norm(epipolar.n2, axis=-1, keepdims=True) for v in (epipolar.n2, epipolar.n1))
    m = np.stack([-n2[:, 1], n2[:, 0]], axis=-1)
    base = -(n2[:, :, None] * n1[:, None, :]).reshape(n, 4)
    return base, np.einsum("ni,jl->nijl", m, np.eye(2)).reshape(n, 4, 2)


def _least_squares(system: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the solutions (N, U), NaN where singular, and the smallest singular values (N,)."""
    transposed = np.swapaxes(system, -1, -2)
    normal = transposed @ system
    good = finite(normal) & finite(right)
    conditioning, out = np.full(len(system), np.nan), np.full((len(system), system.shape[2]), np.nan)
    conditioning[good] = np.sqrt(np.maximum(np.linalg.eigvalsh(normal[good])[:, 0], 0.0))
    good &= np.nan_to_num(conditioning) > SINGULAR
    out[good] = np.linalg.solve(normal[good], (transposed @ right[..., None])[good])[..., 0]
    return out, conditioning
