"""The joint solution of a rig, with outlier frames left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.solving.known import KnownCameras
from rigkit.calibration.rig.solving.lags import Timing, times_of, with_lags
from rigkit.calibration.rig.solving.shape import common_shape
from rigkit.calibration.rig.solving.solver import solve_rig
from rigkit.calibration.rig.solving.state import Key, RigObservations, RigState
from rigkit.calibration.rig.views.board_sizes import board_size_conflicts
from rigkit.calibration.rig.views.disagree import (
    DISAGREES,
    MIN_PX,
    cost_of_sharing,
    cost_with_departures,
    outlier_may_be_hidden,
    outlier_targets,
    reason_left_out,
    separate_distant_views,
    separate_views,
    shared_keys,
    typical_cost,
    typical_distance_px,
)
from rigkit.calibration.rig.views.frames import (
    initial_target_poses,
    mounts_of,
    places_of,
    view_distances_px,
    with_common_orientation,
)
from rigkit.calibration.rig.views.mispaired import mixup_of_all_frames, typical_px
from rigkit.calibration.rig.views.observations import FrameObservations, RigViews
from rigkit.calibration.solving.solver import Solution
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.repeats import cluster_numbers, folds_of
from rigkit.core.arrays import FloatArray, IntArray, scaled_pinv
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Finding, Severity
from rigkit.core.identifiers import natural_key
from rigkit.core.progress import Progress
from rigkit.geometry.rigid3 import Rigid3

MAX_DISTANCE_OF_SIZE = 0.1
"""Typical distance between views that share a pose, as a part of the boards' size in the images, from which the cameras
do not see the same. A board that moves in front of cameras without a common trigger gives a pixel or two, 1 or 2 % of
its size; such frames are still measurements, whose error is in the scatter between frames. Different boards, or frames
that do not belong together, are as far apart as they are large."""
BAD_COST_SIGMAS = 10.0
"""Typical cost of sharing a pose, as a multiple of the corners' noise, from which a rig is not good: it is so much
worse than its cameras."""
MIN_SHARE = 0.5
"""Largest part of the shared targets that may be left out."""
STAGES: Mapping[Timing, str] = {
    "readouts": "rig",
    "lags": "rig without readout times",
    "trigger": "rig without lags",
}
"""Names of the joint solutions for progress."""
MAX_ROUNDS = 8
"""Maximal number of solutions, each without the frames that disagreed in the one before."""
NAMED = 3
"""Number of disagreeing frames that a message lists."""
TRIED = 6
"""Number of the worst targets, of few that all look bad, that are left out by way of trial, one at a time."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointRig:
    """A solved rig.

    Attributes
    ----------
    views : all views, with the keys by which they share poses.
    observations, solution : the observations used, and the solution.
    sigma_px : prior standard deviation of a corner of median quality, from the cameras alone.
    cost_sigmas : typical cost of sharing a pose, in standard deviations; about 1 if the models are right.
    left_out : (frame, target, reason).
    notes : findings about ambiguities.
    known : cameras held at known values.
    """

    views: RigViews
    observations: RigObservations
    solution: Solution[RigState]
    sigma_px: float
    cost_sigmas: float
    left_out: tuple[tuple[str, str, str], ...]
    notes: tuple[Finding, ...]
    known: KnownCameras | None = None

    @cached_property
    def frames(self) -> IntArray:
        """Index of the frame of every pose, (F,): `frame_numbers`."""
        return frame_numbers(self.views, self.observations)

    @property
    def times(self) -> FloatArray:
        """Time of every pose, (F,): `times_of`."""
        return _times(self.views, self.observations)

    def folds(self, count: int) -> IntArray:
        """Return the fold of every pose (F,), of `count` folds; with fewer frames each is a fold."""
        pixels = [view.pixels for own in self.observations.cameras for view in own.views]
        frame = self.frames[np.concatenate(self.observations.frame)]
        return folds_of(pixels, frame, count)[self.frames]

    @property
    def timing(self) -> Timing:
        """What was estimated of the times at which images were taken."""
        exposures = self.solution.state.exposures
        if exposures is None:
            return "trigger"
        return "readouts" if exposures.readouts.any() else "lags"

    @property
    def shared_count(self) -> int:
        """Number of targets, counted in every frame, that several views share."""
        return len(shared_keys(self.views.seen))


def frame_numbers(views: RigViews, observations: RigObservations) -> IntArray:
    """Return the index of the frame of every pose, (F,), in the natural order of the names; near-duplicate frames have
    the index of the first one."""
    frame = {entry.key: entry.frame for own in views.seen for entry in own.values()}
    names = [frame[key] for key in observations.keys]
    shown = [
        (names[f], f"{c} {view.board.board_id}", view.pixels)
        for c, (own, of_views) in enumerate(zip(observations.cameras, observations.frame, strict=True))
        for view, f in zip(own.views, of_views.tolist(), strict=True)
    ]
    frames, boards, pixels = zip(*sorted(shown, key=lambda of: natural_key(of[0])), strict=True)
    number = dict(zip(frames, cluster_numbers(frames, boards, pixels).tolist(), strict=True))
    return np.array([number[name] for name in names], dtype=np.int64)


def solve_jointly(
    views: RigViews, progress: Progress, known: KnownCameras | None = None, *, timing: Timing = "readouts"
) -> JointRig:
    """Return the joint solution, without targets on which the cameras (or the target's boards) disagree; with lags of
    cameras and readouts of rolling shutters if these are significant, and no more of them than `timing` says.

    Raises InputError where a camera shares no target with the others, DegenerateError where too few are left.
    """
    mounts, notes = mounts_of(views)
    mounts = list(mounts) if known is None else known.mounts(views.names, mounts)
    views = with_common_orientation(views, mounts)
    seen, single = views.seen, views.single
    sizes, also = board_size_conflicts(views), tuple[Finding, ...]()
    shared = len(shared_keys(seen))
    left_out = separate_distant_views(seen, view_distances_px(views, mounts))
    sigma = _sigma(single)
    for i in range(MAX_ROUNDS):
        progress(STAGES[timing], i, MAX_ROUNDS)
        _require_agreement(views, len(left_out), shared)
        observations, solution = _solved(views, mounts, sigma, known)
        observations, solution = _with_lags(views, observations, solution, sigma, timing)
        cost = cost_of_sharing(observations, solution, seen)
        typical = typical_cost(cost, sigma)
        worse = outlier_targets(cost, typical)
        if not worse and outlier_may_be_hidden(cost, sigma):
            worse = _single_outlier(views, mounts, sigma, cost, known)
        if not worse or i == MAX_ROUNDS - 1:
            break
        for key in worse:
            how = f"{np.sqrt(cost[key] / max(sigma, MIN_PX) ** 2):.1f} times the corners' noise"
            left_out.append((*key, reason_left_out(seen, key, how)))
            separate_views(seen, key)
        state = solution.state
        mounts = [Rigid3(r, t) for r, t in zip(state.mount_rotation, state.mount_mm, strict=True)]
    progress(STAGES[timing], MAX_ROUNDS, MAX_ROUNDS)
    typical_sigmas = float(np.sqrt(typical) / max(sigma, MIN_PX))
    typical_px, size_px = typical_distance_px(observations, cost), _boards_px(seen)
    _require_common_moments(typical_px, size_px, seen)
    if typical_sigmas > DISAGREES and known is None:
        typical_sigmas = min(typical_sigmas, _sigmas_with_departures(observations, solution, sigma))
    if typical_sigmas > DISAGREES:
        observations = replace(observations, held=_lens_priors(single, sigma, typical_sigmas**2 - 1.0))
        if known is not None:
            observations = known.hold(observations, solution.state, views.names)
        solution = solve_rig(observations, solution.state, sigma)
        # Lenses that are held no longer bend towards frames that do not belong together.
        held_px = typical_distance_px(observations, cost_of_sharing(observations, solution, seen))
        _require_common_moments(held_px, size_px, seen)
        also = (_disagreement(cost, sigma, (typical_px, typical_sigmas), several=len(seen) > 1),)
    return JointRig(
        views=views,
        observations=observations,
        solution=solution,
        sigma_px=sigma,
        cost_sigmas=typical_sigmas,
        left_out=tuple(left_out),
        notes=(*(sizes or also), *notes),
        known=known,
    )


def _sigmas_with_departures(observations: RigObservations, solution: Solution[RigState], sigma: float) -> float:
    """Return the typical cost of sharing poses, in standard deviations, if lenses depart from their models."""
    cost = cost_with_departures(observations, solution, sigma)
    return float("inf") if cost is None else float(np.sqrt(typical_cost(cost, sigma)) / max(sigma, MIN_PX))


def _solved(
    views: RigViews, mounts: Sequence[Rigid3], sigma: float, known: KnownCameras | None
) -> tuple[RigObservations, Solution[RigState]]:
    observations, unknowns = _observations(views, sigma)
    frame_rotation, frame_mm = initial_target_poses(observations.keys, views, mounts)
    boards = observations.cameras[0].boards
    board_rotation, board_mm = places_of((board.board_id for board in boards), views.places)
    start = RigState(
        cameras=tuple(views.cameras),
        mount_rotation=np.array([m.rotation for m in mounts]),
        mount_mm=np.array([m.translation_mm for m in mounts]),
        frame_rotation=frame_rotation,
        frame_mm=frame_mm,
        board_rotation=board_rotation,
        board_mm=board_mm,
        unknowns=unknowns,
    )
    if known is not None:
        observations = known.hold(observations, start, views.names)
    return observations, solve_rig(observations, start, sigma)


def _with_lags(
    views: RigViews, observations: RigObservations, solution: Solution[RigState], sigma: float, timing: Timing
) -> tuple[RigObservations, Solution[RigState]]:
    """Return the observations and the solution, with the lags of cameras if they are significant."""
    times = _times(views, observations)
    return with_lags(observations, solution, sigma, times, frame_numbers(views, observations), timing=timing)


def _times(views: RigViews, observations: RigObservations) -> FloatArray:
    return times_of(observations.keys, {entry.key: entry.frame for own in views.seen for entry in own.values()})


def _boards_px(seen: Sequence[FrameObservations]) -> float:
    """Return the size of boards in the images, px: the median over views of twice the corners' rms distance from their
    centre."""
    entries = [entry for own in seen for entry in own.values()]
    shown = [entry.view.pixels[entry.kept] if entry.kept.any() else entry.view.pixels for entry in entries]
    count = np.array([len(corners) for corners in shown])
    start, every = np.cumsum(count) - count, np.concatenate(shown)
    off = every - np.repeat(np.add.reduceat(every, start) / count[:, None], count, axis=0)
    return float(np.median(2.0 * np.sqrt(np.add.reduceat((off**2).sum(axis=1), start) / count)))


def _disagreement(cost: Mapping[Key, float], sigma: float, typical: tuple[float, float], *, several: bool) -> Finding:
    """Return the finding where the typical cost of sharing poses, `typical` px a corner and sigmas, is not chance."""
    typical_px, typical_sigmas = typical
    worst = sorted(cost, key=lambda key: -cost[key])[:NAMED]
    times = {frame: np.sqrt(cost[frame, target]) / max(sigma, MIN_PX) for frame, target in worst}
    frames = ", ".join(f"'{frame}' ({value:.0f})" for frame, value in times.items())
    what = "the images of a frame are not simultaneous, or the rig is not rigid: one pose per board for all cameras"
    remedy = "trigger the cameras together, and hold boards and rig still"
    if not several:
        what, remedy = "the boards are not rigidly mounted: one pose for all of them", "fasten the boards"
    message = (
        f"{what} leaves residuals of {typical_sigmas:.1f} times the corner noise ({typical_px:.2g} px), most in frames "
        f"{frames}; intrinsics are held near those of each camera alone, and the rig's sigmas follow from the "
        "disagreement between frames"
    )
    return Finding(
        severity=Severity.BAD if typical_sigmas > BAD_COST_SIGMAS else Severity.LOOK, message=message, remedy=remedy
    )


def _lens_priors(
    single: Sequence[Calibration], sigma: float, weight: float
) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Return the prior mean and information of each lens: that of its own calibration, times `weight`.

    If sharing poses typically costs s times as much as by chance, the constraints from shared poses have s times the
    assumed error, and would bias the lenses. So a camera's own corners get s^2 times the weight.
    """
    out = []
    for alone in single:
        # Of independent corners, in px^2 of the joint solution.
        unit = alone.near_covariance[:-6, :-6] / (sigma * alone.overdispersion) ** 2
        out.append((alone.near.parameters, weight * scaled_pinv(unit)))
    return tuple(out)


def _single_outlier(
    views: RigViews, mounts: Sequence[Rigid3], sigma: float, cost: Mapping[Key, float], known: KnownCameras | None
) -> list[Key]:
    """Return the one target, if any, without which the others agree: with few targets an outlier shifts the mounts so
    far that all of them look bad."""
    found: list[tuple[float, float, Key]] = []
    for key in sorted(cost, key=lambda k: -cost[k])[:TRIED]:
        trial = views.with_seen([dict(own) for own in views.seen])
        separate_views(trial.seen, key)
        try:
            mounts_of(trial)
        except InputError:
            continue
        without = cost_of_sharing(*_solved(trial, mounts, sigma, known), trial.seen)
        found.append((sum(without.values()), typical_cost(without, sigma, mean=True), key))
    if not found:
        return []
    rest, typical, key = min(found)
    return [key] if sum(cost.values()) - rest > DISAGREES**2 * typical else []


def _sigma(single: Sequence[Calibration]) -> float:
    """Return the standard deviation of a corner of median quality in the median camera."""
    return float(np.median([c.sigma_px for c in single]))


def _observations(views: RigViews, sigma: float) -> tuple[RigObservations, FloatArray]:
    """Return the padded views of all cameras with one table of boards, weighted by the residuals of each camera alone,
    and the initial unknowns of the boards' shape."""
    entries, places = [list(own.values()) for own in views.seen], views.places
    keys = {key: i for i, key in enumerate(dict.fromkeys(e.key for own in entries for e in own))}
    everything = Observations.from_views([e.view for own in entries for e in own])
    ends = np.cumsum([0, *(len(own) for own in entries)])
    cameras, weights, frame = [], [], []
    for own, first, last, alone in zip(entries, ends[:-1], ends[1:], views.single, strict=True):
        observations = everything.subset(np.arange(first, last))
        kept = np.zeros(observations.present.shape, dtype=bool)
        squared = np.zeros(observations.present.shape)
        kept[observations.present] = np.concatenate([e.kept for e in own])
        squared[observations.present] = np.concatenate([e.squared_px for e in own])
        observations = observations.with_common_error(squared, kept)
        # Cameras differ in sharpness: a residual counts in its own camera's standard deviations.
        better = sigma / max(alone.sigma_px, MIN_PX) if sigma > MIN_PX else 1.0
        cameras.append(observations)
        weights.append(np.where(kept, better * observations.weight, 0.0))
        frame.append(np.array([keys[e.key] for e in own], dtype=np.int64))
    first_of = {target for target, _ in places.values()}
    free = tuple(b.board_id in places and b.board_id not in first_of for b in everything.boards)
    shape, unknowns = common_shape(everything, views.single)
    found = RigObservations(
        cameras=tuple(cameras),
        weights=tuple(weights),
        shape=shape,
        frame=tuple(frame),
        keys=tuple(keys),
        places=free,
    )
    return found, unknowns


def _require_agreement(views: RigViews, left: int, shared: int) -> None:
    """Raise DegenerateError where too many shared targets were left out."""
    if not left:
        return
    advice = _advice(views.seen)
    if left > MIN_SHARE * shared:
        raise DegenerateError(
            f"rig: the views disagree on the poses of {left} of {shared} shared boards, too many to leave out; {advice}"
        )
    try:
        mounts_of(views)
    except InputError as error:
        raise DegenerateError(
            f"{error}; {left} boards were left out because the cameras disagree on their poses: {advice}"
        ) from error


def early_disagreement(views: RigViews) -> str | None:
    """Return words where the mount that fits most frames leaves cameras that are calibrated alone as far apart as the
    joint solution does not permit; None without enough frames. The solution may bring them together yet: it estimates
    lags. REAL: 0.25 of the boards' size for images of different moments; 0.001 to 0.005 for pairs, without a common
    trigger too, 0.05 for boards in hand before free-running cameras. SIMULATED: 0.0013 at most for 36 pairs of 4 and 10
    frames, 0.17 and more with the frames of one camera permuted."""
    distance_px, size_px = typical_px(views), _boards_px(views.seen)
    if not np.isfinite(distance_px) or distance_px <= MAX_DISTANCE_OF_SIZE * size_px:
        return None
    cause = mixup_of_all_frames(views)
    return _far_apart(distance_px, size_px, views.seen) if cause is None else cause.text


def _require_common_moments(distance_px: float, size_px: float, seen: Sequence[FrameObservations]) -> None:
    """Raise DegenerateError where the typical distance between views that share a pose is a large part of the boards'
    size in the images."""
    if distance_px > MAX_DISTANCE_OF_SIZE * size_px:
        raise DegenerateError(f"rig: {_far_apart(distance_px, size_px, seen)}")


def _far_apart(distance_px: float, size_px: float, seen: Sequence[FrameObservations]) -> str:
    return (
        f"the views of a frame disagree by {distance_px:.0f} px on the boards' poses (boards are {size_px:.0f} px "
        f"large); {_advice(seen)}"
    )


def _advice(seen: Sequence[FrameObservations]) -> str:
    if len(seen) > 1:
        return "check that the images of a frame were taken at the same time, and that no two cameras are mixed up"
    return "check that the boards are rigidly mounted to each other"
