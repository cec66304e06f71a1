"""The shape of the boards, with priors as wide as the views say.

A prior that is too wide lets the noise of the views bend a flat board, and the lens with it; one that is too narrow
holds back the corners of a wavy one. The evidence of the views tells how wide it should be. Each board has a size of
its own for bows, for stretches, and for the stray of single corners in the plane and out of it. The size follows
MacKay's update sigma^2 = sum u^2 / gamma, where gamma = sum (1 - variance / prior^2) is how many of the unknowns u the
views determine.

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
"""More rounds change the sizes by a few per cent and the lens not at all."""
STRAY_SIGMAS = 3.0
"""Corners stray where they take this many standard deviations more off the cost than chance does."""
OPEN = 1e-9
"""A direction of which the views know this part of what they know of the best is open: it is rounding."""
SIZES_TOLERANCE = 1e-4
"""The rounds stop where a step promises less than this part of the cost: sizes are known to a tenth at best."""
MIN_SIZE = 1e-4
"""A size falls to no less than this part of the first one in a round: on exact data it would fall to nothing."""


def fit_shapes(observations: Observations, fit: Fit, board: str) -> dict[str, Fit]:
    """Return the fits with boards of the shape `board` ("warp", "released", or "auto": both), from that with flat ones.
    With "auto" corners are only released where they stray at all."""
    shape = shape_model("warp", observations)
    start = replace(fit.state, shape=shape, unknowns=np.zeros(shape.count))
    state, kept = _evident(observations, start, fit.kept)
    found: dict[str, Fit] = {}
    if board != "released":
        found["warp"] = warp = fit_kept(observations, state, kept, settle=True)
        state, kept = warp.state, warp.kept
    if board == "released" or (board == "auto" and _stray(observations, state, kept)):
        shape, unknowns = state.shape.richer("released", observations, state.unknowns)
        state, kept = _evident(observations, replace(state, shape=shape, unknowns=unknowns), kept)
        found["released"] = fit_kept(observations, state, kept, settle=True)
    return found


def _stray(observations: Observations, state: State, kept: BoolArray) -> bool:
    """Say whether corners lie elsewhere than the warp has them, by more than chance: what releasing each alone would
    take off the cost, g^T H^-1 g, is chi-squared with as many degrees of freedom as the views know directions of it."""
    shape = replace(shape_model("released", observations), basis=state.shape.basis)
    unknowns = np.concatenate([state.unknowns, np.zeros(shape.count - state.shape.count)])
    weight = np.where(kept, observations.weight, 0.0)
    normal = normal_equations(observations, replace(state, shape=shape, unknowns=unknowns), weight)
    points = len(shape.released)
    # In one view a residual is all that is seen of a corner; from one side nothing tells how far off it is.
    seen = np.bincount(observations.corner[kept], minlength=len(shape.flat))[shape.released] > 1
    size, axes = np.linalg.eigh(_own_blocks(normal, points))
    along = np.swapaxes(axes, -1, -2) @ normal.g[-3 * points :].reshape(points, 3, 1)
    known = seen[:, None] & (size > OPEN * size[:, -1:])
    less = along[known, 0] ** 2 / size[known]
    count = int(known.sum())
    views = int(kept.any(axis=1).sum())
    freedom = max(2 * int(kept.sum()) - state.camera.parameters.size - 6 * views, 1)
    variance = float((normal.residuals[0].weighted(observations)[kept] ** 2).sum()) / freedom
    return bool(less.sum() > variance * (count + STRAY_SIGMAS * np.sqrt(2.0 * count)))


def _own_blocks(normal: NormalEquations, points: int) -> FloatArray:
    """Return the 3x3 blocks (M, 3, 3) of the released corners."""
    each, start = np.arange(points), len(normal.g) - 3 * points
    return np.asarray(normal.gg[start:, start:].reshape(points, 3, points, 3)[each, :, each, :])


def _evident(observations: Observations, state: State, kept: BoolArray) -> tuple[State, BoolArray]:
    """Return the state, roughly solved, with its priors as wide as the views say, and the corners to keep."""
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
    """Return the variance of each unknown of the shape for corners of unit variance. That of a released corner is taken
    with the others held: against the exact one its sizes come out the same within a tenth, without the inverse of a
    matrix of thousands."""
    count, first = state.shape.count, state.shape.basis.shape[-1]
    if state.shape.kind == "warp":
        return np.diag(normal.covariance[0])[-count:]
    own = np.diagonal(np.linalg.inv(_own_blocks(normal, (count - first) // 3)), axis1=-2, axis2=-1)
    return np.concatenate([np.zeros(first), own.ravel()])
