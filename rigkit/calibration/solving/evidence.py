"""Board shapes with prior widths estimated from the views (empirical Bayes).

A prior that is too wide lets noise bend a flat board, and biases the lens; one that is too narrow keeps the corners of
a wavy board from moving. So the widths maximise the evidence. Each board has one width for its bows, one for its
stretches, and one each for displacements of released corners in the plane and out of it. They follow MacKay's update
sigma^2 = sum u^2 / gamma, where gamma = sum (1 - variance / prior^2) is the number of unknowns u that the views
determine.

Reference: D. MacKay, "Bayesian interpolation", Neural Computation 4 (1992), section 4.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.solving.fit import Fit, fit_kept
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.normal_equations import NormalEquations
from rigkit.calibration.solving.outliers import inliers, sigma_of
from rigkit.calibration.solving.shape import released_groups, shape_model, warp_groups
from rigkit.calibration.solving.solver import solve, with_priors
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray, FloatArray

SIZE_ROUNDS = 2
"""More rounds change the widths by a few per cent and the lens not at all."""
CHANCE_SIGMAS = 3.0
"""Unknowns are added where they lower the cost by this many standard deviations more than chance: without need they are
in 2 % of cases where it is one, in 0.3 % where they are 100."""
OPEN = 1e-9
"""Relative eigenvalue up to which a direction of a corner is undetermined: rounding."""
SIZES_TOLERANCE = 1e-4
"""Relative decrease of the cost at which a round stops: widths are known to a tenth at best."""
MIN_SIZE = 1e-4
"""Smallest factor of a width in a round: on exact data it would become zero."""


def fit_shapes(observations: Observations, fit: Fit, board: str) -> dict[str, Fit]:
    """Return the fits with boards of the shape `board` ("warp", "released", or "auto": both), from the fit with flat
    boards. With "auto" corners are only released where they deviate significantly from the warp."""
    shape = shape_model("warp", observations)
    start = replace(fit.state, shape=shape, unknowns=np.zeros(shape.count))
    state, kept = _with_estimated_priors(observations, start, fit.kept)
    found: dict[str, Fit] = {}
    if board != "released":
        found["warp"] = warp = fit_kept(observations, state, kept, settle=True)
        state, kept = warp.state, warp.kept
    if board == "released" or (board == "auto" and _corners_depart(observations, state, kept)):
        shape, unknowns = state.shape.richer("released", observations, state.unknowns)
        state, kept = _with_estimated_priors(observations, replace(state, shape=shape, unknowns=unknowns), kept)
        found["released"] = fit_kept(observations, state, kept, settle=True)
    return found


def chance_limit(count: int) -> float:
    """Return the decrease of a cost of unit variance up to which `count` more unknowns are needless: by chance it is
    chi-squared, with mean n and standard deviation sqrt(2 n)."""
    return float(count + CHANCE_SIGMAS * np.sqrt(2.0 * count))


def _corners_depart(observations: Observations, state: State, kept: BoolArray) -> bool:
    """Return whether corners deviate significantly from the warp: the decrease of the cost by releasing each alone,
    g^T H^-1 g, is chi-squared with as many degrees of freedom as the views determine directions of it."""
    shape = replace(shape_model("released", observations), basis=state.shape.basis)
    unknowns = np.concatenate([state.unknowns, np.zeros(shape.count - state.shape.count)])
    weight = np.where(kept, observations.weight, 0.0)
    normal = normal_equations(observations, replace(state, shape=shape, unknowns=unknowns), weight)
    points = len(shape.released)
    # A corner needs two views; along the line of sight common to all of them its position is undetermined.
    seen = np.bincount(observations.corner[kept], minlength=len(shape.flat))[shape.released] > 1
    size, axes = np.linalg.eigh(normal.point_blocks)
    along = np.swapaxes(axes, -1, -2) @ normal.g[-3 * points :].reshape(points, 3, 1)
    known = seen[:, None] & (size > OPEN * size[:, -1:])
    less = along[known, 0] ** 2 / size[known]
    count = int(known.sum())
    views = int(kept.any(axis=1).sum())
    freedom = max(2 * int(kept.sum()) - state.camera.parameters.size - 6 * views, 1)
    variance = float((normal.residuals[0].weighted(observations)[kept] ** 2).sum()) / freedom
    return bool(less.sum() > variance * chance_limit(count))


def _with_estimated_priors(observations: Observations, state: State, kept: BoolArray) -> tuple[State, BoolArray]:
    """Return the state, roughly solved, with prior widths that maximise the evidence, and the corners to keep."""
    norm = evaluate(state, observations).weighted(observations)
    for _ in range(SIZE_ROUNDS):
        solution = solve(
            observations,
            state,
            weight=np.where(kept, observations.weight, 0.0),
            prior_sigma_px=sigma_of(norm, kept),
            cost_tolerance=SIZES_TOLERANCE,
        )
        state, norm = solution.state, solution.data.residuals[0].weighted(observations)
        sigma = sigma_of(norm, kept)
        normal = with_priors(solution.data, state, sigma)
        state = replace(state, shape=replace(state.shape, sigma=_sizes(observations, state, normal, sigma)))
        kept = inliers(norm, observations, sigma, state.camera.size_px, solution.data.residuals[0].px)
    return state, kept


def _sizes(observations: Observations, state: State, normal: NormalEquations, sigma_px: float) -> FloatArray:
    """Return the prior standard deviation of each unknown of the shape."""
    sizes = state.shape.sigma.copy()
    known = 1.0 - _variance(state, normal) * sigma_px**2 / sizes**2
    released = state.shape.kind == "released"
    groups = released_groups(observations, state.shape.basis.shape[-1]) if released else warp_groups(observations)
    for group in groups:
        if (gamma := float(known[group].sum())) > 0.0:
            found = np.sqrt((state.unknowns[group] ** 2).sum() / gamma)
            sizes[group] = max(float(found), MIN_SIZE * float(sizes[group].max()))
    return sizes


def _variance(state: State, normal: NormalEquations) -> FloatArray:
    """Return the variance of each unknown of the shape for corners of unit variance. That of a released corner is
    computed with the others held: the widths agree with the exact ones within a tenth, without inverting a matrix of
    thousands."""
    count, first = state.shape.count, state.shape.basis.shape[-1]
    if state.shape.kind == "warp":
        return np.diag(normal.covariance[0])[-count:]
    own = np.diagonal(np.linalg.inv(normal.point_blocks), axis1=-2, axis2=-1)
    return np.concatenate([np.zeros(first), own.ravel()])
