"""Cameras without a common trigger: each has a time lag behind the first, in which boards move on.

Lags are solved for together with all other unknowns, with the boards' trajectories (`exposure_times`) recomputed from
the resulting poses. They are kept only where frames agree on them far beyond their scatter: boards at rest, or placed
anew for every frame, contain no information on lags, and trajectories through such frames are not real motion.

The lag of a free-running camera differs between frames. The standard deviation of that is estimated over all frames
from the disagreement of views that share a pose, along their trajectories (expectation maximisation). The time of each
image is then eliminated from its view.

Reference: A. P. Dempster, N. M. Laird, D. B. Rubin, "Maximum likelihood from incomplete data via the EM algorithm",
J. R. Statist. Soc. B 39 (1977), section 4.5, on variances of random effects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from rigkit.calibration.rig.certainty.frame_covariance import frame_covariance, residual_sigma
from rigkit.calibration.rig.solving.exposure_times import POINTS, ExposureTimes, Lag, trajectories_through
from rigkit.calibration.rig.solving.pose_jacobians import pose_jacobians_at_exposure
from rigkit.calibration.rig.solving.shape import STEP_DAMPING
from rigkit.calibration.rig.solving.shutters import readout_steps, with_longer_readouts
from rigkit.calibration.rig.solving.solver import rig_normal, solve_rig
from rigkit.calibration.rig.solving.state import Key, RigObservations, RigState
from rigkit.calibration.solving.clustered import LARGE_FREEDOM
from rigkit.calibration.solving.evidence import chance_limit
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.solver import FROM_OPTIMUM, Solution
from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.identifiers import last_number, natural_key

Timing = Literal["trigger", "lags", "readouts"]
TIMINGS: tuple[Timing, ...] = ("trigger", "lags", "readouts")
"""What is estimated of the times at which images were taken: nothing, lags and times of images, and also the readout
times of rolling shutters."""
LAG_SIGNIFICANCE = 0.01
"""Significance level: the part of triggered rigs that get lags by mistake, which are then consistent with zero."""
MAX_ROUNDS, SETTLED_COST = 8, 0.01
"""Trajectories and times of images are recomputed until the cost changes by less than this part."""
MAX_READOUT_ROUNDS, SETTLED_READOUT_SIGMAS, MAX_RELAXATION = 16, 0.1, 10.0
"""A step of readouts holds the rig, which follows: a part of the error is left, or the step goes too far. Steps are
lengthened or shortened, up to so many times, by Aitken's relaxation (U. Kuettler, W. A. Wall, Comput. Mech. 43, 2008)
until they are this small a part of their sigmas."""
FIRST_SPREAD, MIN_LAG_SPREAD, SPREAD_ROUNDS = 0.1, 1e-4, 50
"""Standard deviation of the lags of a camera's images, in the time between frames: the initial value, the least one
that is distinguishable from zero, and the number of iterations."""
ORDERS_DRAWN = 199
"""Random permutations of the trajectories in the test of scatter."""
POSE_RIDGE, HELD = 1e-9, 1e12
"""As parts of the largest information: regularises poses with few corners, and fixes the time that defines a frame."""


def times_of(keys: Sequence[Key], frames: Mapping[Key, str]) -> FloatArray:
    """Return the time of every key, (F,), in units of the median time between two frames; NaN for views that share no
    pose. It is the last number in the names of `frames`, or their order where these numbers do not increase."""
    names = sorted({frame for key, frame in frames.items() if key[0] == frame}, key=natural_key)
    in_names = [last_number(name) for name in names]
    numbers = np.array([float(n) if n.isdecimal() else 0.0 for n in in_names])
    if not (np.diff(numbers) > 0.0).all():
        numbers = np.arange(float(len(names)))
    typical = np.median(np.diff(numbers)) if len(names) > 1 else 1.0
    time = dict(zip(names, ((numbers - numbers[:1]) / typical).tolist(), strict=True))
    return np.array([time[key[0]] if frames[key] == key[0] else np.nan for key in keys])


def with_lags(
    observations: RigObservations,
    solution: Solution[RigState],
    sigma_px: float,
    times: FloatArray,
    frames: IntArray,
    *,
    timing: Timing,
) -> tuple[RigObservations, Solution[RigState]]:
    """Return the observations corrected for rolling shutters, and the solution with lags and times of images; or both
    unchanged where the lags are not significant.

    `times` (F,) of the keys, `sigma_px` as for `solve_rig`, `frames` as for `frame_covariance`, `timing`: what is
    looked for.
    """
    cameras, keys = len(observations.cameras), len(observations.keys)
    none = np.zeros((cameras, keys))
    start = ExposureTimes(none[:, 0], np.zeros((keys, 0, 6)), none, np.full_like(none, np.inf), none[:, 0])
    start = with_trajectories(start, solution.state, observations, times)
    if (
        timing == "trigger"
        or cameras < 2
        or not start.trajectories.any()
        or not _lags_lower_cost(observations, solution.state, start, sigma_px)
    ):
        return observations, solution
    lagging = replace(solution, state=replace(solution.state, exposures=start))
    for own_times in (False, True):
        for _ in range(MAX_ROUNDS):
            before = lagging.normal.cost
            lagging = _solved_again(observations, lagging, sigma_px, times, own_times=own_times)
            if abs(before - lagging.normal.cost) < SETTLED_COST * before:
                break
        if not own_times and _p_value_of_lags(observations, lagging, sigma_px, frames) > LAG_SIGNIFICANCE:
            sigma = residual_sigma(observations, solution, sigma_px)
            if _p_value_of_scatter(solution.state, observations, start, sigma) > LAG_SIGNIFICANCE:
                return observations, solution
    if timing == "lags":
        return observations, lagging
    return _with_readouts(observations, lagging, sigma_px, times)


def _solved_again(
    observations: RigObservations, lagging: Solution[RigState], sigma_px: float, times: FloatArray, *, own_times: bool
) -> Solution[RigState]:
    """Return the solution with trajectories through its own poses, and with the images' times estimated from them."""
    state = lagging.state
    assert state.exposures is not None
    exposures = with_trajectories(state.exposures, state, observations, times)
    if own_times:
        sigma = residual_sigma(observations, lagging, sigma_px)
        exposures = _with_own_times(replace(state, exposures=exposures), exposures, observations, sigma)
    return solve_rig(observations, replace(state, exposures=exposures), sigma_px, FROM_OPTIMUM)


def _with_readouts(
    observations: RigObservations, lagging: Solution[RigState], sigma_px: float, times: FloatArray
) -> tuple[RigObservations, Solution[RigState]]:
    """Return observations and solution with the readouts of rolling shutters, or both unchanged where no readout is
    significant."""
    # Imported here: scipy is slow to import, and few rigs need it.
    from scipy.special import chdtrc, stdtr

    step, sigma, freedom = readout_steps(observations, lagging.state)
    size = np.abs(step) / np.where(sigma > 0.0, sigma, np.inf)
    each = np.maximum(2.0 * stdtr(np.maximum(freedom, 1.0), -size), np.finfo(float).tiny)
    # All cameras of a rig may have rolling shutters (Fisher's combination of their p-values), or one of them.
    together, one = float(chdtrc(2 * len(each), -2.0 * np.log(each).sum())), float(each.min()) * len(each)
    if 2.0 * min(together, one) > LAG_SIGNIFICANCE:
        return observations, lagging
    relaxation = 1.0
    for _ in range(MAX_READOUT_ROUNDS):
        state, now = lagging.state, relaxation * step
        assert state.exposures is not None
        observations = with_longer_readouts(observations, state, now)
        exposures = replace(state.exposures, readouts=state.exposures.readouts + now)
        lagging = replace(lagging, state=replace(state, exposures=exposures))
        lagging = _solved_again(observations, lagging, sigma_px, times, own_times=True)
        before, (step, sigma, _) = step, readout_steps(observations, lagging.state)
        change = before - step
        relaxation *= float(before @ change) / max(float(change @ change), np.finfo(float).tiny)
        relaxation = min(max(relaxation, 1.0 / MAX_RELAXATION), MAX_RELAXATION)
        if (np.abs(max(relaxation, 1.0) * step) <= SETTLED_READOUT_SIGMAS * sigma).all():
            break
    return observations, lagging


def lags_of(names: Sequence[str], state: RigState, covariance: FloatArray, lags: slice) -> dict[str, Lag]:
    """Return the lags of all cameras but the first by their `names`, where they were solved for; `covariance` (G, G) is
    that of the globals, among which the slice `lags` is theirs."""
    if state.exposures is None:
        return {}
    sigmas, out = np.sqrt(np.diag(covariance)[lags]), {}
    for c, sigma in enumerate(sigmas.tolist(), 1):
        known = state.exposures.information[c]
        # The only image, or the first, of a frame defines the frame's time: it has no scatter.
        scatter = float(np.std(state.exposures.own[c][np.isfinite(known)])) if np.isfinite(known).any() else 0.0
        out[names[c]] = Lag(float(state.exposures.lags[c]), sigma, scatter)
    return out


def with_trajectories(
    exposures: ExposureTimes, state: RigState, observations: RigObservations, times: FloatArray, points: int = POINTS
) -> ExposureTimes:
    """Return the exposure times with trajectories through `points` poses of a state each."""
    targets = [target for _, target in observations.keys]
    through = trajectories_through(state.frame_rotation, state.frame_mm, targets, times, points)
    return replace(exposures, trajectories=through)


def _lags_lower_cost(observations: RigObservations, state: RigState, start: ExposureTimes, sigma_px: float) -> bool:
    """Say whether a step with lags lowers the cost by more than chance would."""
    state = replace(state, exposures=start)
    normal, more = rig_normal(observations, state, sigma_px), len(state.cameras) - 1
    step, before = normal.step(STEP_DAMPING), normal.cost / max(2 * observations.corner_count, 1)
    limit = max(before, sigma_px**2) * chance_limit(more)
    return step is not None and step.predicted > limit


def _p_value_of_lags(
    observations: RigObservations, solution: Solution[RigState], sigma_px: float, frames: IntArray
) -> float:
    """Return the p-value of the lags: Wald's test, with the scatter between frames."""
    # Imported here: scipy is slow to import, and few rigs need it.
    from scipy.special import fdtrc

    assert solution.state.exposures is not None
    found, run = solution.state.exposures.lags[1:], solution.state.layout(observations).lags
    known = frame_covariance(observations, solution, sigma_px, frames)[0].clustered
    size = float(found @ np.linalg.pinv(known.covariance[run, run], hermitian=True) @ found) / len(found)
    return float(fdtrc(len(found), min(known.freedom, LARGE_FREEDOM), size))


def _with_own_times(
    state: RigState, exposures: ExposureTimes, observations: RigObservations, sigma_px: float
) -> ExposureTimes:
    """Return the exposure times with the estimated time of every image and the standard deviation of a camera's times.
    All but the poses is held; `sigma_px` is the standard deviation of a corner."""
    by_target = _information_by_target(state, observations)
    free = _free_times(by_target)
    products = _products_with_times(by_target, exposures.all_speeds())
    spread, own = np.where(free.any(axis=0), FIRST_SPREAD, 0.0), exposures.own.T
    for _ in range(SPREAD_ROUNDS):
        system, information = _with_time_prior(products, free, (sigma_px / np.maximum(spread, MIN_LAG_SPREAD)) ** 2)
        right = products[..., -1].copy()
        right[:, 6:] -= information * own
        inverse = np.linalg.inv(system)
        found = own + np.einsum("fij,fj->fi", inverse, right)[:, 6:]
        second = (found**2 + sigma_px**2 * np.einsum("fii->fi", inverse)[:, 6:]) * free
        spread = np.sqrt(second.sum(axis=0) / np.maximum(free.sum(axis=0), 1))
    information = np.where(free, information, np.inf)
    return replace(exposures, own=np.where(free, found, 0.0).T, information=information.T)


def cost_of_own_times(observations: RigObservations, state: RigState, sigma_px: float) -> float:
    """Return what the images' own times cost where they were fitted to the observations, px^2: their distance from the
    lags under the prior, and what fitting them gains by chance, so that the cost with it is that of frames whose times
    are predicted (twice the negative logarithm of the marginal likelihood, times `sigma_px` squared)."""
    if state.exposures is None:
        return 0.0
    by_target = _information_by_target(state, observations)
    own, information = state.exposures.own.T, state.exposures.information.T
    free = _free_times(by_target) & np.isfinite(information)
    system, prior = _with_time_prior(_products_with_times(by_target, state.exposures.all_speeds()), free, information)
    chance = np.linalg.slogdet(system)[1] - np.linalg.slogdet(system[:, :6, :6])[1] - np.log(prior).sum(axis=1)
    return float((own[free] ** 2 * prior[free]).sum() + sigma_px**2 * chance.sum())


def _information_by_target(state: RigState, observations: RigObservations) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the information (n, F, 6, 6) and score (n, F, 6) of the views of n cameras about the targets at the time
    of the view, and the derivatives (n, F, 6, 6) of these target poses by the poses of the keys."""
    shape = len(state.cameras), len(observations.keys)
    information, score, follow = np.zeros((*shape, 6, 6)), np.zeros((*shape, 6)), np.zeros((*shape, 6, 6))
    follow[:] = np.eye(6)
    for c, own in enumerate(observations.cameras):
        alone, frame = state.of_camera(c, observations), observations.frame[c]
        normal = normal_equations(own, alone.with_corners_held(), observations.weights[c])
        turned = state.targets(c, observations)[0] @ np.swapaxes(state.frame_rotation[frame], -1, -2)
        follow[c, frame, :3, :3] = turned
        for part in pose_jacobians_at_exposure(observations, state, c, alone.translation_mm):
            back = np.swapaxes(part.target, -1, -2)
            np.add.at(information[c], part.poses, back @ normal.pp[part.views] @ part.target)
            np.add.at(score[c], part.poses, (back @ normal.p[part.views][:, :, None])[..., 0])
    return information, score, follow


def _products_with_times(by_target: tuple[FloatArray, FloatArray, FloatArray], speeds: FloatArray) -> FloatArray:
    """Return the products (F, 6 + n, 7 + n) for every pose: of the derivatives by it and by the image times of n
    cameras with each other and with the residual. Targets have `speeds` (n, F, 6)."""
    information, score, by_pose = by_target
    cameras, keys = score.shape[:2]
    follow = np.zeros((cameras, keys, 6, 6 + cameras))
    follow[..., :6] = by_pose
    for c in range(cameras):
        follow[c, :, :, 6 + c] = speeds[c]
    back = np.swapaxes(follow, -1, -2)
    summed: FloatArray = np.concatenate([back @ information @ follow, back @ score[..., None]], axis=-1).sum(axis=0)
    return summed


def _with_time_prior(products: FloatArray, free: BoolArray, known: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Return the normal matrices (F, 6 + n, 6 + n) of the `products`, with a ridge on the poses and the prior
    information (F, n) of the image times, also returned: `known` where `free` (F, n), else so much that they are
    fixed."""
    system = products[..., :-1].copy()
    diagonal = np.einsum("fii->fi", system)
    largest = np.maximum(diagonal.max(axis=1, keepdims=True), 1.0)
    information = np.where(free, known, HELD * largest)
    diagonal[:, :6] += POSE_RIDGE * largest
    diagonal[:, 6:] += information
    return system, information


def _free_times(by_target: tuple[FloatArray, FloatArray, FloatArray]) -> BoolArray:
    """Return the mask (F, n) of the free image times: the pose of a frame is at the time of the first camera that sees
    it, which is fixed."""
    shown = np.einsum("nfii->nf", by_target[0]) > 0.0
    return np.asarray((shown & (np.cumsum(shown, axis=0) > 1)).T)


def _p_value_of_scatter(state: RigState, observations: RigObservations, start: ExposureTimes, sigma_px: float) -> float:
    """Return the p-value of the agreement gained by image times of their own: permuted trajectories, which have nothing
    to do with the views, gain as much by chance."""
    by_target, rng = _information_by_target(state, observations), np.random.default_rng(0)
    free, known = _free_times(by_target), (sigma_px / FIRST_SPREAD) ** 2
    trajectories = start.trajectories[:, 0]
    moving = np.flatnonzero(trajectories.any(axis=1))

    def gain(own: FloatArray) -> float:
        products = _products_with_times(by_target, np.broadcast_to(own, (free.shape[1], *own.shape)))
        right = products[..., -1:]
        return float((right * np.linalg.solve(_with_time_prior(products, free, known)[0], right)).sum())

    found, better = gain(trajectories), 0
    for _ in range(ORDERS_DRAWN):
        other = trajectories.copy()
        other[moving] = trajectories[rng.permutation(moving)]
        better += gain(other) >= found
    return (better + 1.0) / (ORDERS_DRAWN + 1.0)
