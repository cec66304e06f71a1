"""Fit of one camera model to all views: initial values, robust solve, outlier rejection, least squares on inliers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rigkit.calibration.solving.initialise import initialise
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.normal_equations import NormalEquations, Residuals
from rigkit.calibration.solving.outliers import OUTLIER_SIGMAS, inliers, sigma_of
from rigkit.calibration.solving.poses import find_poses, refine_poses
from rigkit.calibration.solving.solver import Convergence, solve, with_priors
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import DegenerateError, InputError
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

CAUCHY_SIGMAS = 2.5
COARSE_TOLERANCE = 5e-2
FINE = 1e-5
"""Relative predicted decrease at which the robust solves stop: they only find outliers, and start the least squares."""
GOOD_ENOUGH = 1e-3
"""A scatter of this part of the image's width ends the search for better initial values: 1.6 px of 1600."""
SETTLE_ROUNDS = 8
START_MM = 1000.0
MAX_SCATTER_OF_VIEW = 2.0
"""The pose of a view with this many times the scatter of all views is estimated again: its tilt may have the wrong
sign (planar ambiguity)."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A solved model.

    Attributes
    ----------
    state : the solution.
    data : its normal equations, without priors.
    kept : (V, C) the inliers.
    sigma_px : standard deviation of a corner per coordinate.
    convergence : of the final solve.
    """

    state: State
    data: NormalEquations
    kept: BoolArray
    sigma_px: float
    convergence: Convergence

    def weight(self, observations: Observations) -> FloatArray:
        """Return the weights of the kept corners, zero elsewhere."""
        return np.where(self.kept, observations.weight, 0.0)

    @cached_property
    def normal(self) -> NormalEquations:
        """The normal equations in px^-2, priors included."""
        return with_priors(self.data, self.state, self.sigma_px)

    @property
    def residuals(self) -> Residuals:
        """Residuals of all corners."""
        return self.data.residuals[0]

    @property
    def rms_px(self) -> float:
        """2-D RMS over the kept corners, px."""
        return float(np.sqrt((self.residuals.px**2).sum(axis=-1)[self.kept].mean()))


def robust_sigma(fit: Fit, observations: Observations) -> float:
    """Return the robust standard deviation of all corners, weighted, px."""
    return sigma_of(fit.residuals.weighted(observations), observations.present)


def fit_model(observations: Observations, size_px: tuple[int, int], model: type[Camera], order: int | None) -> Fit:
    """Return the model fitted to all views, without initial values.

    Raises DegenerateError where no solution explains the views, or there are not more residuals than unknowns.
    """
    best: _Found | None = None
    for start in initialise(observations, size_px, model, order):
        here = _Found.at(start, normal_equations(observations, start), observations)
        if not np.isfinite(here.sigma_px):
            continue
        found = _without_outliers(observations, here) or _robust(observations, start, here.sigma_px)
        if best is None or found.sigma_px < best.sigma_px:
            best = found
        if found.sigma_px < GOOD_ENOUGH * size_px[0]:
            break
    if best is not None:
        kept = inliers(best.norm, observations, best.sigma_px, size_px, best.px)
        clean = bool((kept == observations.present).all())
        fit = _settled(observations, best.state, best.norm, kept, SETTLE_ROUNDS, best.data if clean else None)
        if np.isfinite(robust_sigma(fit, observations)):
            return fit
    raise DegenerateError(
        f"calibration: no {model.model} camera fits the views, even roughly; check columns, rows and size of the "
        "board, and take views in which it is tilted"
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Found:
    """A robust solution, its residuals `px`, their weighted lengths `norm` and robust standard deviation, and the
    normal equations of all corners there, if known."""

    state: State
    px: FloatArray
    norm: FloatArray
    sigma_px: float
    data: NormalEquations | None = None

    @classmethod
    def at(cls, state: State, data: NormalEquations, observations: Observations) -> _Found:
        """Return the solution at a state from its normal equations."""
        norm = data.residuals[0].weighted(observations)
        return cls(state, data.residuals[0].px, norm, sigma_of(norm, observations.present), data)


def _without_outliers(observations: Observations, start: _Found) -> _Found | None:
    """Return the state after one step of least squares if it has no outlier, None otherwise: a robust solve is then
    unnecessary."""
    sigma = start.sigma_px
    one = solve(observations, start.state, prior_sigma_px=sigma, max_iterations=1, at_start=start.data)
    found = _Found.at(one.state, one.data, observations)
    return found if found.sigma_px <= sigma and found.norm.max() <= OUTLIER_SIGMAS * found.sigma_px else None


def _robust(observations: Observations, state: State, start_sigma: float) -> _Found:
    """Return the result of a coarse and a fine robust solve, with the poses of badly fitting views estimated again in
    between. `start_sigma` is that of `state`."""
    present = observations.present
    loss = CAUCHY_SIGMAS * start_sigma
    coarse = solve(observations, state, loss_px=loss, max_iterations=15, cost_tolerance=COARSE_TOLERANCE)
    state, norm = coarse.state, coarse.data.residuals[0].weighted(observations)
    sigma = sigma_of(norm, present)
    if not norm.max() > OUTLIER_SIGMAS * sigma:
        return _Found(state, coarse.data.residuals[0].px, norm, sigma)  # No outlier: the fine solve is unnecessary.
    # Padding is infinite, and sorted behind all corners.
    ordered = np.sort(np.where(present, norm, np.inf), axis=1)
    of_view = ordered[np.arange(len(norm)), np.maximum(present.sum(axis=1) - 1, 0) // 2] / MEDIAN_OF_RAYLEIGH
    bad = np.flatnonzero(of_view > MAX_SCATTER_OF_VIEW * sigma)
    if bad.size:
        part = observations.subset(bad)
        found = find_poses(part, state.subset(bad), part.weight, CAUCHY_SIGMAS * sigma)
        rotation, translation = state.rotation.copy(), state.translation_mm.copy()
        rotation[bad], translation[bad] = found.rotation, found.translation_mm
        state = replace(state, rotation=rotation, translation_mm=translation)
    fine = solve(observations, state, loss_px=CAUCHY_SIGMAS * sigma, max_iterations=30, cost_tolerance=FINE)
    norm = fine.data.residuals[0].weighted(observations)
    return _Found(fine.state, fine.data.residuals[0].px, norm, sigma_of(norm, present))


def posed(observations: Observations, camera: Camera) -> tuple[State, BoolArray]:
    """Return the poses of all views for a known camera, each at its own minimum, and the inliers (V, C)."""
    count = len(observations.views)
    place = np.broadcast_to([0.0, 0.0, START_MM], (count, 3)).copy()
    start = State.start(camera, np.broadcast_to(np.eye(3), (count, 3, 3)).copy(), place, observations)
    state = find_poses(observations, start, observations.weight, None)
    norm = evaluate(state, observations).weighted(observations)
    sigma = sigma_of(norm, observations.present)
    if norm.max() > OUTLIER_SIGMAS * sigma:
        state = find_poses(observations, state, observations.weight, CAUCHY_SIGMAS * sigma)
        norm = evaluate(state, observations).weighted(observations)
        sigma = sigma_of(norm, observations.present)
    kept = inliers(norm, observations, sigma, camera.size_px)
    for _ in range(SETTLE_ROUNDS):
        state, _ = refine_poses(observations, state, np.where(kept, observations.weight, 0.0))
        norm = evaluate(state, observations).weighted(observations)
        agree = inliers(norm, observations, sigma_of(norm, kept), camera.size_px)
        if (agree == kept).all():
            break
        kept = agree
    return state, kept


def fit_kept(observations: Observations, state: State, kept: BoolArray, *, settle: bool = False) -> Fit:
    """Return the least-squares solution on the kept corners; with `settle` outliers are determined again and the
    solution repeated until the inliers no longer change."""
    norm = evaluate(state, observations).weighted(observations)
    return _settled(observations, state, norm, kept, SETTLE_ROUNDS if settle else 1)


def fit_other_lens(observations: Observations, state: State, kept: BoolArray) -> Fit:
    """Return the least-squares solution on the kept corners from the lens of another fit."""
    # Poses of another lens could lead the solver to another minimum: they are refined first.
    state, _ = refine_poses(observations, state, np.where(kept, observations.weight, 0.0))
    # The scatter, which weights the priors, is known after the first solve.
    return fit_kept(observations, fit_kept(observations, state, kept).state, kept)


def _settled(
    observations: Observations,
    state: State,
    norm: FloatArray,
    kept: BoolArray,
    rounds: int,
    data: NormalEquations | None = None,
) -> Fit:
    """As `fit_kept`, from the weighted residuals `norm` of the state, and the normal equations of the kept corners
    there, if known."""
    for again in range(1, rounds + 1):
        weight = np.where(kept, observations.weight, 0.0)
        sigma = sigma_of(norm, kept)
        # Where most corners do not project there is no scatter to weight a prior by.
        prior = sigma if np.isfinite(sigma) else 0.0
        solution = solve(observations, state, weight=weight, prior_sigma_px=prior, at_start=data)
        data = None
        state, norm = solution.state, solution.data.residuals[0].weighted(observations)
        px = solution.data.residuals[0].px
        agree = inliers(norm, observations, sigma_of(norm, kept), state.camera.size_px, px)
        if again == rounds or (agree == kept).all():
            break
        kept = agree
    return Fit(state, solution.data, kept, _sigma(state, float(solution.data.costs.sum()), kept), solution.convergence)


def _sigma(state: State, total: float, kept: BoolArray) -> float:
    """Return the standard deviation per coordinate of a corner of median quality, from the sum `total` of the squared
    weighted residuals and the degrees of freedom.

    Raises DegenerateError where there are none: any camera then fits exactly.
    """
    prior = float(((state.unknowns / state.shape.sigma) ** 2).sum()) if state.shape.count else 0.0
    views = int(kept.any(axis=1).sum())
    # The prior of an unknown of the shape counts as a measurement, so that both cancel.
    freedom = 2 * int(kept.sum()) - state.camera.parameters.size - 6 * views
    if freedom <= 0:
        raise DegenerateError(
            f"calibration: a {state.camera.model} camera of {state.camera.parameters.size} parameters and the poses of "
            f"{views} views are at least as many unknowns as corner coordinates; take more views"
        )
    sigma = np.sqrt(total / freedom)
    return float(np.sqrt((total + prior * sigma**2) / freedom)) if prior else float(sigma)


def identifiable(fit: Fit) -> bool:
    """Return whether the images determine all parameters of the camera.

    A parameter without effect at the solution, such as eucm's beta where alpha vanishes, may pass the test of the
    scaled normal equations. Then its standard deviation exceeds the model's limits on both sides.
    """
    if not fit.normal.identifiable:
        return False
    camera = fit.state.camera
    sigma = fit.sigma_px * np.sqrt(np.diag(fit.normal.covariance[0])[: camera.parameters.size])
    # Models limit each parameter by itself: if all steps at once are within the limits, each alone is.
    return _within_limits(camera, sigma) or all(
        _within_limits(camera, step) or _within_limits(camera, -step) for step in np.diag(sigma)
    )


def _within_limits(camera: Camera, step: FloatArray) -> bool:
    """Return whether the parameters plus `step` (P,) are within the model's limits."""
    try:
        camera.with_parameters(camera.parameters + step)
    except InputError:
        return False
    return True


def not_identifiable(model: str) -> DegenerateError:
    """Return the error for a model whose parameters the images do not determine."""
    return DegenerateError(
        f"calibration: a {model} camera is not identifiable from these images: other parameters fit equally well; use "
        "a simpler model, or take views with the board tilted by 20 to 50 degrees, also near the image border"
    )
