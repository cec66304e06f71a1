"""Weights of point and affinity rows in linear solvers: the inverse standard deviations of their residuals.

The residual of a point's row has the standard deviation sqrt(sigma1^2 |n1|^2 + sigma2^2 |n2|^2). That of an affinity's
rows is sigma_A |n2| plus, in quadrature, the contribution of the pixels' noise (`pixel_share`). n1 and n2 are the
gradients of the epipolar constraint by the pixels.

Erratum: L. Hajder, "Affine Correspondences in Stereo Vision", expects affinities to improve F, with equal weights in
normalised coordinates. With more than a few points these make the pose worse than points alone; the rule "equal"
exists for replication.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3
from rigkit.core.errors import InputError
from rigkit.core.matches import Matches
from rigkit.geometry.sampson import epipolar_normals
from rigkit.optim.robust_scale import robust_sigma

WeightRule = Literal["noise", "auto", "equal", "points"]
"""noise: from the sigmas of the matches (affinities without a sigma_A are ignored); auto: sigma_A estimated from the
data; equal: equal weights of all rows in normalised coordinates; points: affinities ignored."""

START_SIGMA_A = 0.05
"""Initial sigma_A of the rule "auto", before it is estimated."""
MIN_SIGMA_A = 1e-6
"""Lower bound of an estimated sigma_A, for exact affinities: weights are its inverse."""


@dataclass(frozen=True, eq=False, slots=True)
class RowWeights:
    """Factors of the rows of each match.

    Attributes
    ----------
    points : (N,) factor of the point's row; 0 excludes the point.
    affinities : (N,) factor of the two affinity rows; 0 if there is no affinity or it is not used.
    sigma_A : (N,) assumed standard deviation of an entry of A21, NaN if unused.
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
    """Return the initial sigma_A (N,) under `rule`; NaN for affinities that are not used."""
    usable = usable_affinities(matches)
    if rule == "noise" and matches.sigma_A is not None:
        return np.where(usable & (matches.sigma_A > 0.0), matches.sigma_A, np.nan)
    if rule in ("noise", "points"):
        return np.full(len(matches), np.nan)
    if rule in ("auto", "equal"):
        return np.where(usable, START_SIGMA_A, np.nan)
    raise InputError(f"weights '{rule}' are unknown; use 'noise', 'auto', 'equal' or 'points'")


def px_angles(matches: Matches) -> tuple[FloatArray, FloatArray]:
    """Return the angle per pixel (N,), rad, at the rays of either image: the rms column norm of the ray Jacobian."""
    size1, size2 = (np.sqrt(0.5 * np.sum(b * b, axis=(-2, -1))) for b in (matches.jacobians1, matches.jacobians2))
    return size1, size2


def initial_weights(matches: Matches, sigma_A: FloatArray) -> RowWeights:
    """Return weights before E is known: |n1| and |n2| are approximated by `px_angles`."""
    return _weights(matches, *px_angles(matches), sigma_A)


def noise_weights(matches: Matches, E21: Mat3, sigma_A: FloatArray) -> RowWeights:
    """Return the inverse standard deviation of each row at the epipolar geometry `E21`."""
    _, n1, n2 = epipolar_normals(E21, matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2)
    share = None if np.isnan(sigma_A).all() else pixel_share(matches, E21)
    return _weights(matches, np.linalg.norm(n1, axis=-1), np.linalg.norm(n2, axis=-1), sigma_A, share)


def pixel_share(matches: Matches, E21: Mat3) -> FloatArray:
    """Return the variance (N,) of a component of A^T n2 + n1 (mean of both) due to pixel noise; NaN without A.

    Unlike sigma_A |n2| it does not vanish at the epipole, where noise determines the direction of an epipolar line.

    Notes
    -----
    With M = B2^T E B1 the derivatives of A^T n2 + n1 by the pixels are A^T M and M^T. The derivatives of B1 and B2 are
    neglected: along the line of sight they multiply A^T n2 + n1 = 0, and those due to lens distortion are far smaller.
    """
    m = matches
    if m.A21 is None:
        return np.full(len(m), np.nan)
    M = np.swapaxes(m.jacobians2, -1, -2) @ E21 @ m.jacobians1
    by1, by2 = (np.sum(d**2, axis=(1, 2)) for d in (np.swapaxes(m.A21, -1, -2) @ M, M))
    return np.asarray(0.5 * (m.sigma1_px**2 * by1 + m.sigma2_px**2 * by2))


def equal_weights(matches: Matches) -> RowWeights:
    """Return equal weights of all rows, affinities' rows divided by the mean of `px_angles` of image 1."""
    usable, unit = usable_affinities(matches), px_angles(matches)[0].mean()
    return RowWeights(np.ones(len(matches)), np.where(usable, 1.0 / unit, 0.0), np.full(len(matches), np.nan))


def affinity_residuals(matches: Matches, E21: Mat3) -> FloatArray:
    """Return the residuals (A^T n2 + n1) / |n2| (N, 2) of the affinities, in units of an entry of A; NaN without A."""
    if matches.A21 is None:
        return np.full((len(matches), 2), np.nan)
    _, n1, n2 = epipolar_normals(E21, matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2)
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = ((n2[:, None, :] @ matches.A21)[:, 0, :] + n1) / np.linalg.norm(n2, axis=-1, keepdims=True)
    return np.asarray(residual)


def affinity_distances(matches: Matches, E21: Mat3) -> FloatArray:
    """Return |A^T n2 + n1| (N,) in standard deviations of a component; NaN without an affinity or its sigma_A."""
    m = matches
    if m.A21 is None or m.sigma_A is None:
        return np.full(len(m), np.nan)
    _, n1, n2 = epipolar_normals(E21, m.rays1, m.rays2, m.jacobians1, m.jacobians2)
    violation = np.linalg.norm((n2[:, None, :] @ m.A21)[:, 0, :] + n1, axis=1)
    variance = m.sigma_A**2 * np.sum(n2**2, axis=1) + pixel_share(m, E21)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(violation / np.sqrt(variance))


def estimate_sigma_A(matches: Matches, E21: Mat3) -> float:
    """Return a robust (median) standard deviation of an entry of A21 from its residuals at `E21`; NaN without A21.

    Meaningless for affinities computed from the epipolar geometry (F2UDIR, F3UDIR): they satisfy it by construction.
    """
    residual = affinity_residuals(matches, E21)
    return robust_sigma(residual[np.isfinite(residual)])


def _weights(
    matches: Matches, size1: FloatArray, size2: FloatArray, sigma_A: FloatArray, share: FloatArray | None = None
) -> RowWeights:
    of_point = np.sqrt((matches.sigma1_px * size1) ** 2 + (matches.sigma2_px * size2) ** 2)
    # The residual of a point at the epipole has no variance; the floor keeps its weight finite.
    floor = 1e-3 * float(np.median(of_point))
    points = 1.0 / np.maximum(of_point, floor if floor > 0.0 else 1.0)
    used = np.isfinite(sigma_A)
    of_affinity = sigma_A * np.maximum(size2, 1e-3 * float(np.median(size2)))
    if share is not None:
        of_affinity = np.sqrt(of_affinity**2 + share)
    return RowWeights(points, np.where(used, 1.0 / np.where(used, of_affinity, 1.0), 0.0), sigma_A)
