"""The result type of the epipolar solvers, their common reweighting loop and their common checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.geometry.rotation import nearest_rotation, unit
from rigkit.geometry.sampson import sampson_of_matches
from rigkit.relative_pose.solvers.weights import (
    MIN_SIGMA_A,
    RowWeights,
    WeightRule,
    assumed_sigma_A,
    equal_weights,
    estimate_sigma_A,
    initial_weights,
    noise_weights,
    usable_affinities,
)

REWEIGHTINGS = 3
"""The weights depend on the geometry only weakly: the third repetition changes E by less than 1e-3 of its error."""
ROTATION_SIGMAS = 4.0
"""A rotation explains the matches if its chi square exceeds the expected one by fewer standard deviations than this."""


@dataclass(frozen=True, eq=False, slots=True)
class EpipolarEstimate:
    """The epipolar geometry of a pair.

    Attributes
    ----------
    E21 : (3, 3) essential matrix (two equal singular values), unit Frobenius norm, x2^T E21 x1 = 0 on rays.
    F21 : (3, 3) fundamental matrix of the pixels, unit Frobenius norm; None unless both images are perspective. The
        general solver's F21 is the unconstrained one (seven degrees of freedom), E21 its projection.
    residuals_px : (N,) signed Sampson distances of the pixels from E21.
    weights : row weights of the last iteration.
    """

    E21: Mat3
    F21: Mat3 | None
    residuals_px: FloatArray
    weights: RowWeights


class FundamentalSolver(Protocol):
    """A solver of the epipolar geometry under one pose type."""

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of the epipolar geometry under that pose type."""
        ...

    def solve(self, matches: Matches, weights: WeightRule | None = None) -> EpipolarEstimate:
        """Estimate the epipolar geometry; `weights` None is the rule "noise". Raises DegenerateError or InputError."""
        ...


def reweighted(
    matches: Matches, rule: WeightRule | None, solve: Callable[[RowWeights], FloatArray]
) -> tuple[FloatArray, RowWeights]:
    """Return E21 (3, 3) and row weights after iterating `solve(row weights)` and the weights at its solution.

    The rule "equal" needs no iteration. The rule "auto" estimates sigma_A anew in every iteration. None is the rule
    "noise".
    """
    rule = "noise" if rule is None else rule
    if not isinstance(rule, str):
        raise InputError(f"weights: the name of a rule is needed, got {type(rule).__name__}")
    if rule == "equal":
        row_weights = equal_weights(matches)
        return solve(row_weights), row_weights
    sigma_A = assumed_sigma_A(matches, rule)
    row_weights = initial_weights(matches, sigma_A)
    E21 = solve(row_weights)
    for _ in range(REWEIGHTINGS):
        if rule == "auto":
            sigma_A = np.where(usable_affinities(matches), max(estimate_sigma_A(matches, E21), MIN_SIGMA_A), np.nan)
        row_weights = noise_weights(matches, E21, sigma_A)
        E21 = solve(row_weights)
    return E21, row_weights


def finish(matches: Matches, E21: Mat3, F_rays: Mat3, weights: RowWeights) -> EpipolarEstimate:
    """Return the estimate with unit norms, residuals, and F21 in pixels if both camera matrices are known."""
    E21 = E21 / np.linalg.norm(E21)
    F21 = None
    if matches.K1 is not None and matches.K2 is not None:
        F21 = np.linalg.inv(matches.K2).T @ F_rays @ np.linalg.inv(matches.K1)
        F21 = F21 / np.linalg.norm(F21)
    return EpipolarEstimate(E21, F21, sampson_of_matches(E21, matches), weights)


def check_count(matches: Matches, weights: RowWeights, minimum: int, what: str) -> None:
    """Raise InputError if fewer than `minimum` rows have a weight."""
    rows = int((weights.points > 0.0).sum() + 2 * (weights.affinities > 0.0).sum())
    if rows < minimum:
        raise InputError(
            f"{what}: {len(matches)} matches give {rows} equations and {minimum} are needed "
            f"({minimum} points, or {-(-minimum // 3)} affine correspondences); add matches or name a simpler pose type"
        )


def check_baseline(matches: Matches) -> None:
    """Raise DegenerateError if a rotation alone explains the matches: without a baseline E is not determined.

    This is a chi square test of the best rotation f2 = R f1 with the sigmas of the matches. Raises InputError if there
    are no matches.
    """
    n = len(matches)
    if n == 0:
        raise InputError("there are no matches: nothing to estimate an epipolar geometry from")
    if n == 1:
        return
    square = np.sum(transfer_error(matches, nearest_rotation(matches.rays2.T @ matches.rays1)) ** 2, axis=1)
    freedom = 2 * n - 3
    chi2 = float(np.sum(square / (matches.sigma1_px**2 + matches.sigma2_px**2)))
    if chi2 < freedom + ROTATION_SIGMAS * np.sqrt(2.0 * freedom):
        rms = float(np.sqrt(np.mean(square)))
        raise DegenerateError(
            f"no baseline: a rotation alone explains the {n} matches (rms {rms:.3g} px, within their noise); "
            "use two images taken from different places"
        )


def transfer_error(matches: Matches, H21: Mat3) -> FloatArray:
    """Return the transfer errors (N, 2), px of image 2, of the homography of rays f2 ~ `H21` f1."""
    difference = matches.rays2 - unit(matches.rays1 @ H21.T)
    B = matches.jacobians2
    gram = np.swapaxes(B, -1, -2) @ B
    return np.asarray(np.linalg.solve(gram, np.swapaxes(B, -1, -2) @ difference[..., None])[..., 0])
