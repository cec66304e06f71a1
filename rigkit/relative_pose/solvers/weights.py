"""How much a point counts and how much an affinity: by their noise.

A linear solver sees the residual of a row multiplied by its weight. The residual of a point's row has the standard
deviation sqrt(sigma1^2 |n1|^2 + sigma2^2 |n2|^2), that of an affinity's rows sigma_A |n2|, and what the pixels add
(n1, n2: gradients of the epipolar constraint by the pixels). Weights are one over these.

Erratum: L. Hajder, "Affine Correspondences in Stereo Vision", expects affinities to improve F, with equal weights in
normalised coordinates. With more than a few points these make the pose worse than points alone; they are kept as the
rule "equal" for replication.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3
from rigkit.core.errors import InputError
from rigkit.core.matches import Matches
from rigkit.geometry.sampson import epipolar_normals
from rigkit.optim.robust_scale import SIGMA_OF_MEDIAN

WeightRule = Literal["noise", "auto", "equal", "points"]
"""noise: from the sigmas of the matches (affinities without a sigma_A are ignored); auto: sigma_A estimated from the
data; equal: every row counts the same in normalised coordinates; points: affinities ignored."""

START_SIGMA_A = 0.05
"""Where nothing is known of the affinities, the estimate starts from here; it is replaced by what the data say."""
MIN_SIGMA_A = 1e-6
"""Exact affinities show none at all, and weights are one over it."""


@dataclass(frozen=True, eq=False, slots=True)
class RowWeights:
    """Factors of the rows of each match.

    Attributes
    ----------
    points : (N,) factor of the point's row; 0 leaves the point out.
    affinities : (N,) factor of the two affinity rows; 0 where there is no affinity or it is not used.
    sigma_A : (N,) standard deviation of an entry of A21 that was assumed, NaN where unused.
    """

    points: FloatArray
    affinities: FloatArray
    sigma_A: FloatArray


def usable_affinities(matches: Matches) -> BoolArray:
    """Return which matches have a finite affinity (N,)."""
    if matches.A21 is None:
        return np.zeros(len(matches), dtype=bool)
    return np.asarray(np.isfinite(matches.A21).all(axis=(-2, -1)))


def assumed_sigma_A(matches: Matches, rule: WeightRule) -> FloatArray:
    """Return the standard deviation (N,) of the affinities that `rule` starts from; NaN where they are not used."""
    usable = usable_affinities(matches)
    if rule == "points":
        return np.full(len(matches), np.nan)
    if rule == "noise":
        if matches.sigma_A is None:
            return np.full(len(matches), np.nan)
        return np.where(usable & (matches.sigma_A > 0.0), matches.sigma_A, np.nan)
    if rule in ("auto", "equal"):
        return np.where(usable, START_SIGMA_A, np.nan)
    raise InputError(f"weights '{rule}' are unknown; use 'noise', 'auto', 'equal' or 'points'")


def initial_weights(matches: Matches, sigma_A: FloatArray) -> RowWeights:
    """Return weights that need no epipolar geometry yet: n1 and n2 are taken as long as the ray Jacobians."""
    size1, size2 = (np.sqrt(0.5 * np.sum(b * b, axis=(-2, -1))) for b in (matches.jacobians1, matches.jacobians2))
    return _weights(matches, size1, size2, sigma_A)


def noise_weights(matches: Matches, E21: Mat3, sigma_A: FloatArray) -> RowWeights:
    """Return one over the standard deviation of each row, at the epipolar geometry `E21`."""
    _, n1, n2 = epipolar_normals(E21, matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2)
    share = None if np.isnan(sigma_A).all() else pixel_share(matches, E21)
    return _weights(matches, np.linalg.norm(n1, axis=-1), np.linalg.norm(n2, axis=-1), sigma_A, share)


def pixel_share(matches: Matches, E21: Mat3) -> FloatArray:
    """Return the variance (N,) that the noise of the pixels adds to a component of A^T n2 + n1 (the mean of the two).

    It does not vanish with n2 towards the epipole, where the noise decides how an epipolar line runs. NaN without A.

    Notes
    -----
    With M = B2^T E B1 the derivatives of A^T n2 + n1 by the pixels are A^T M and M^T, but for how B1 and B2 change with
    them. They change along the line of sight, which multiplies the zero A^T n2 + n1, and by the lens's distortion, far
    less.
    """
    m = matches
    if m.A21 is None:
        return np.full(len(m), np.nan)
    M = np.swapaxes(m.jacobians2, -1, -2) @ E21 @ m.jacobians1
    by1, by2 = (np.sum(d**2, axis=(1, 2)) for d in (np.swapaxes(m.A21, -1, -2) @ M, M))
    return np.asarray(0.5 * (m.sigma1_px**2 * by1 + m.sigma2_px**2 * by2))


def equal_weights(matches: Matches) -> RowWeights:
    """Return the same weight for all rows, in coordinates where a pixel of image 1 is as large as its ray Jacobian."""
    usable = usable_affinities(matches)
    size1 = np.sqrt(0.5 * np.sum(matches.jacobians1**2, axis=(-2, -1)))
    return RowWeights(np.ones(len(matches)), np.where(usable, 1.0 / size1.mean(), 0.0), np.full(len(matches), np.nan))


def affinity_residuals(matches: Matches, E21: Mat3) -> FloatArray:
    """Return (A^T n2 + n1) / |n2| (N, 2): what the affinities violate the geometry by, in entries of A; NaN if none."""
    if matches.A21 is None:
        return np.full((len(matches), 2), np.nan)
    _, n1, n2 = epipolar_normals(E21, matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2)
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = ((n2[:, None, :] @ matches.A21)[:, 0, :] + n1) / np.linalg.norm(n2, axis=-1, keepdims=True)
    return np.asarray(residual)


def affinity_distances(matches: Matches, E21: Mat3) -> FloatArray:
    """Return |A^T n2 + n1| (N,) in standard deviations of a component, by sigma_A and the pixels' sigmas.

    NaN where there is no affinity, or nothing is known of its noise.
    """
    m = matches
    if m.A21 is None or m.sigma_A is None:
        return np.full(len(m), np.nan)
    _, n1, n2 = epipolar_normals(E21, m.rays1, m.rays2, m.jacobians1, m.jacobians2)
    violation = np.linalg.norm((n2[:, None, :] @ m.A21)[:, 0, :] + n1, axis=1)
    variance = m.sigma_A**2 * np.sum(n2**2, axis=1) + pixel_share(m, E21)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(violation / np.sqrt(variance))


def estimate_sigma_A(matches: Matches, E21: Mat3) -> float:
    """Return the standard deviation of an entry of A21 that the epipolar geometry `E21` shows (robust: median).

    NaN without affinities. Meaningless for affinities that were computed from the epipolar geometry itself (F2UDIR,
    F3UDIR): they satisfy it by construction and must not be used to estimate it.
    """
    residual = affinity_residuals(matches, E21)
    residual = residual[np.isfinite(residual)]
    return float(SIGMA_OF_MEDIAN * np.median(np.abs(residual))) if residual.size else float("nan")


def _weights(
    matches: Matches, size1: FloatArray, size2: FloatArray, sigma_A: FloatArray, share: FloatArray | None = None
) -> RowWeights:
    of_point = np.sqrt((matches.sigma1_px * size1) ** 2 + (matches.sigma2_px * size2) ** 2)
    # Near an epipole a row says nothing; the floor keeps its weight finite.
    floor = 1e-3 * float(np.median(of_point))
    points = 1.0 / np.maximum(of_point, floor if floor > 0.0 else 1.0)
    used = np.isfinite(sigma_A)
    of_affinity = sigma_A * np.maximum(size2, 1e-3 * float(np.median(size2)))
    if share is not None:
        of_affinity = np.sqrt(of_affinity**2 + share)
    return RowWeights(points, np.where(used, 1.0 / np.where(used, of_affinity, 1.0), 0.0), sigma_A)
