"""One model fitted to all views: start, robust solve, outliers by a stated rule, least squares on what is kept."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.arrays import BoolArray, FloatArray
from rigkit.calibration.initialise import initialise, start_error
from rigkit.calibration.observations import Observations
from rigkit.calibration.poses import find_poses, refine_poses
from rigkit.calibration.result import Convergence
from rigkit.calibration.solver import State, evaluate, solve
from rigkit.cameras.base import Camera
from rigkit.errors import DegenerateError

__all__ = ["OUTLIER_SIGMAS", "Fit", "fit_kept", "fit_model", "heldout_rms", "inliers", "rms", "robust_sigma"]

OUTLIER_SIGMAS = 5.0
"""A corner is an outlier when its weighted 2-D residual exceeds this many robust standard deviations per coordinate,
sigma = median |r| / 1.177: by chance alone 4 corners in a million do."""
RAYLEIGH_MEDIAN = 1.17741
"""Median of |r| of a 2-D Gaussian with unit standard deviation per coordinate."""
CAUCHY_SIGMAS = 2.5
SIGMA_FLOOR_PX = 1e-4
"""Exact corners have no scatter to judge outliers by: below this rounding would make them."""
GOOD_ENOUGH = 1e-3
"""A scatter of this part of the image's width ends the search for a better start: 1.6 px of 1600."""
BAD_VIEW = 2.0
"""A view with this many times the scatter of all gets its pose found anew: perhaps its tilt has the wrong sign."""


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """A solved model: its state, the corners kept (V, C), sigma per coordinate of a corner, how the solver ended."""

    state: State
    kept: BoolArray
    sigma_px: float
    convergence: Convergence

    def weight(self, observations: Observations) -> FloatArray:
        """Return the weights of the kept corners, zero elsewhere."""
        return np.where(self.kept, observations.weight, 0.0)


def robust_sigma(state: State, observations: Observations, used: BoolArray | None = None) -> float:
    """Return median |weighted residual| / 1.177 in px over the corners `used` (all by default)."""
    used = observations.present if used is None else used & observations.present
    norm = evaluate(state, observations).norm(observations) * observations.weight
    return max(float(np.median(norm[used])) / RAYLEIGH_MEDIAN, SIGMA_FLOOR_PX) if used.any() else SIGMA_FLOOR_PX


def inliers(state: State, observations: Observations, sigma_px: float) -> BoolArray:
    """Return which corners the rule keeps, (V, C)."""
    norm = evaluate(state, observations).norm(observations) * observations.weight
    with np.errstate(invalid="ignore"):
        return np.asarray(observations.present & (norm <= OUTLIER_SIGMAS * sigma_px))


def rms(state: State, observations: Observations, kept: BoolArray) -> float:
    """Return the 2-D RMS in px over the kept corners."""
    squared = (evaluate(state, observations).px[kept] ** 2).sum(axis=-1)
    return float(np.sqrt(squared.mean())) if squared.size else float("nan")


def fit_model(observations: Observations, size_px: tuple[int, int], model: type[Camera], order: int | None) -> Fit:
    """Return the model fitted to all views from no guess.

    Raises DegenerateError where no start explains the views.
    """
    best: tuple[float, State] | None = None
    for start in initialise(observations, size_px, model, order):
        if not np.isfinite(start_error(start, observations)):
            continue
        state = _robust(observations, start)
        sigma = robust_sigma(state, observations)
        if best is None or sigma < best[0]:
            best = (sigma, state)
        if sigma < GOOD_ENOUGH * size_px[0]:
            break
    if best is None:
        raise DegenerateError(
            f"calibration: no {model.model} camera explains the views even roughly; take views in which the board is "
            "tilted, and check the board's size"
        )
    sigma, state = best
    kept = inliers(state, observations, sigma)
    return fit_kept(observations, state, kept, settle=True)


def _robust(observations: Observations, state: State) -> State:
    """Return the state after a coarse and a fine robust solve; views that fit badly get their pose found anew."""
    loss = CAUCHY_SIGMAS * robust_sigma(state, observations)
    state, _ = solve(observations, state, loss_px=loss, max_iterations=15, cost_tolerance=1e-3)
    norm = evaluate(state, observations).norm(observations)
    sigma = robust_sigma(state, observations)
    if not float(np.nanmax(norm * observations.weight)) > OUTLIER_SIGMAS * sigma:
        return state  # nothing for a robust loss to do
    with np.errstate(invalid="ignore"):
        of_view = np.nanmedian(norm, axis=1) / RAYLEIGH_MEDIAN
    bad = np.flatnonzero(of_view > BAD_VIEW * sigma)
    if bad.size:
        part = observations.subset(bad)
        found = find_poses(part, state.subset(bad), part.weight, CAUCHY_SIGMAS * sigma)
        rotation, translation = state.rotation.copy(), state.translation_mm.copy()
        rotation[bad], translation[bad] = found.rotation, found.translation_mm
        state = replace(state, rotation=rotation, translation_mm=translation)
    state, _ = solve(observations, state, loss_px=CAUCHY_SIGMAS * sigma, max_iterations=30, cost_tolerance=1e-5)
    return state


def fit_kept(observations: Observations, state: State, kept: BoolArray, *, settle: bool = False) -> Fit:
    """Return the least-squares solution on the kept corners; with `settle` the rule is applied again to the result,
    until the set of kept corners no longer changes (three rounds at most)."""
    for _ in range(3):
        sigma = robust_sigma(state, observations, kept)
        weight = np.where(kept, observations.weight, 0.0)
        state, convergence = solve(observations, state, weight=weight, prior_sigma_px=sigma)
        again = inliers(state, observations, robust_sigma(state, observations, kept)) if settle else kept
        if (again == kept).all():
            break
        kept = again
    return Fit(state, kept, _sigma(observations, state, kept), convergence)


def _sigma(observations: Observations, state: State, kept: BoolArray) -> float:
    """Return the standard deviation per coordinate of a corner of median quality, degrees of freedom counted."""
    squared = (evaluate(state, observations).px ** 2).sum(axis=-1) * observations.weight**2
    prior = float(((state.unknowns / state.shape.sigma) ** 2).sum()) if state.shape.count else 0.0
    views = int(kept.any(axis=1).sum())
    # Each prior is a measurement too: it pays for the unknown that it holds.
    freedom = 2 * int(kept.sum()) - state.camera.parameters.size - 6 * views
    total = float(squared[kept].sum())
    if freedom <= 0:
        return float("nan")
    sigma = np.sqrt(total / freedom)
    return float(np.sqrt((total + prior * sigma**2) / freedom))


def heldout_rms(observations: Observations, fit: Fit, folds: int) -> float | None:
    """Return the 2-D RMS over images that took no part: camera and shape from the other images, only the poses of the
    held-out boards refitted; kept corners only. None with fewer images than folds."""
    images = list(dict.fromkeys(observations.images))
    if folds < 2 or len(images) < folds:
        return None
    fold = np.array([images.index(name) % folds for name in observations.images])
    squared, count = 0.0, 0
    weight = fit.weight(observations)
    for k in range(folds):
        train, test = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        state, _ = solve(
            observations.subset(train),
            fit.state.subset(train),
            weight=weight[train],
            prior_sigma_px=fit.sigma_px if np.isfinite(fit.sigma_px) else 1.0,
            cost_tolerance=1e-6,
        )
        part = observations.subset(test)
        start = fit.state.subset(test)
        moved = State(state.camera, start.rotation, start.translation_mm, state.shape, state.unknowns)
        found, _ = refine_poses(part, moved, weight[test])
        kept = fit.kept[test]
        squared += float((evaluate(found, part).px[kept] ** 2).sum())
        count += int(kept.sum())
    return float(np.sqrt(squared / count)) if count else None
