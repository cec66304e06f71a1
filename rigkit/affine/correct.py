"""Affinities made consistent with the epipolar geometry by the smallest change (EG-L2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.components import finite
from rigkit.core.arrays import Affines, BoolArray, FloatArray
from rigkit.core.errors import InputError

__all__ = ["correct_affines", "correct_frames", "epipolar_residuals"]


def epipolar_residuals(A21: Affines, epipolar: EpipolarNormals) -> FloatArray:
    """Return (A21^T n2 + n1) / |n2|, (N, 2): zero for an affinity of a surface, in the unit of A."""
    with np.errstate(divide="ignore", invalid="ignore"):
        raw = np.einsum("nij,ni->nj", A21, epipolar.n2) + epipolar.n1
        return np.asarray(raw / np.linalg.norm(epipolar.n2, axis=-1, keepdims=True))


def correct_affines(A21: Affines, epipolar: EpipolarNormals) -> tuple[Affines, BoolArray]:
    """Return the affinities nearest to A21 (N, 2, 2) in the Frobenius norm with A^T n2 + n1 = 0, and where defined.

    Undefined (NaN) at the epipole, n2 = 0.

    Notes
    -----
    A - n2 (n2^T A + n1^T) / (n2 . n2), an orthogonal projection (Barath, Matas, Hajder, "Accurate closed-form
    estimation of local affine transformations consistent with the epipolar geometry", BMVC 2016).
    """
    residual = epipolar_residuals(A21, epipolar)
    with np.errstate(divide="ignore", invalid="ignore"):
        n2_hat = epipolar.n2 / np.linalg.norm(epipolar.n2, axis=-1, keepdims=True)
    out = A21 - n2_hat[:, :, None] * residual[:, None, :]
    valid = finite(out)
    return np.where(valid[:, None, None], out, np.nan), valid


def correct_frames(
    frames: FloatArray, pairs: Sequence[tuple[int, int]], epipolars: Sequence[EpipolarNormals]
) -> tuple[FloatArray, BoolArray]:
    """Return the local frames of V views nearest to `frames` that agree with the epipolar geometry of every pair.

    Parameters
    ----------
    frames : (N, V, 2, 2) local affine frames M_i = d pixel_i / d surface, so that A_ji = M_j M_i^-1.
    pairs : view numbers (i, j) of each epipolar geometry.
    epipolars : the normals of each pair, n1 in view i, n2 in view j.

    Notes
    -----
    M_i^T n1 + M_j^T n2 = 0 for every pair; the component of the stacked frames in the row space of these equations is
    removed. Cycles of views make rows dependent (to rounding); the pseudo-inverse takes care of that.
    """
    n, views = np.shape(frames)[:2]
    if len(pairs) != len(epipolars) or any(not (0 <= i < views and 0 <= j < views and i != j) for i, j in pairs):
        raise InputError("correct_frames: one epipolar geometry a pair, pairs of two different view numbers")
    rows = np.zeros((n, len(pairs), views, 2))
    for k, ((i, j), epipolar) in enumerate(zip(pairs, epipolars, strict=True)):
        with np.errstate(divide="ignore", invalid="ignore"):
            length = np.sqrt(np.sum(epipolar.n1**2 + epipolar.n2**2, axis=-1, keepdims=True))
            rows[:, k, i], rows[:, k, j] = epipolar.n1 / length, epipolar.n2 / length
    system = rows.reshape(n, len(pairs), 2 * views)
    stacked = np.asarray(frames, dtype=np.float64).reshape(n, 2 * views, 2)
    valid = finite(system) & finite(stacked)
    out = np.full(stacked.shape, np.nan)
    inverse = np.linalg.pinv(system[valid], rcond=RANK_TOLERANCE)
    out[valid] = stacked[valid] - inverse @ (system[valid] @ stacked[valid])
    return out.reshape(n, views, 2, 2), valid


RANK_TOLERANCE = 1e-6
"""Equations of a cycle of views agree to the accuracy of the epipolar geometry, not to rounding."""
