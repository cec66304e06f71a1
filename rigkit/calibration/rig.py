"""Several cameras on one mount, from synchronous views of boards: all intrinsics and all mounts solved together.

The rig's frame is that of its first camera. Not every camera need see every board in every frame: it is enough that the
cameras hang together through boards that two of them see at once. A frame in which several boards are seen counts each
board on its own; the boards may move between frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.arrays import FloatArray, Points, as_array
from rigkit.calibration.calibrate import FOLDS, calibrate
from rigkit.calibration.normal import Normal
from rigkit.calibration.result import Calibration, Convergence
from rigkit.calibration.rig_frames import Key, Seen, apart, first_frames, mounts_of, seen_by, turned_alike
from rigkit.calibration.rig_solver import RigObservations, RigState, solve_rig
from rigkit.cameras.base import Camera
from rigkit.detections import BoardView
from rigkit.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew
from rigkit.progress import Progress, silent

__all__ = ["RigCalibration", "RigCamera", "calibrate_rig"]

FAR_APART = 12.0
"""Before the joint solve a board's pose in one image may be off by some pixels in the other: only more than this many
times the usual distance is a board that moved."""
DISAGREES = 3.5
"""After it sharing a pose costs a board little: by chance seldom more than twice what it usually costs."""
LEAST_PX = 0.02
"""Without noise the usual residual is rounding, and many times that is rounding as well."""
MAX_ROUNDS = 8


@dataclass(frozen=True, eq=False, slots=True)
class RigCamera:
    """A camera of a rig: what it is called, how it sees, where it sits, and its own 2-D RMS in px."""

    name: str
    camera: Camera
    cam_from_rig: Rigid3
    rms_px: float


@dataclass(frozen=True, eq=False, slots=True)
class RigCalibration:
    """A calibrated rig.

    Attributes
    ----------
    cameras : in the order given; the first is the rig's frame.
    rms_px : 2-D RMS per corner over all cameras, sqrt(mean |residual|^2).
    covariance : of all intrinsics, camera by camera, then of the mounts of all cameras but the first: left perturbation
        (rad) and translation (mm), six each.
    sigma_px : standard deviation of a corner per coordinate.
    single : each camera calibrated alone, with its own verdicts.
    convergence : of the joint solve.
    corner_count : corners used.
    shared_count : boards, counted in every frame, that several cameras saw at once.
    left_out : (frame, board, reason) of boards on which the cameras disagree: each camera's own calibration uses them,
        the mounts do not.
    scale_sigma : relative standard deviation of all lengths, from how well the boards' squares were measured.
    """

    cameras: tuple[RigCamera, ...]
    rms_px: float
    covariance: FloatArray
    sigma_px: float
    single: tuple[Calibration, ...]
    convergence: Convergence
    corner_count: int = 0
    shared_count: int = 0
    left_out: tuple[tuple[str, str, str], ...] = ()
    scale_sigma: float = 0.0

    def __post_init__(self) -> None:
        count = sum(c.camera.parameters.size for c in self.cameras) + 6 * (len(self.cameras) - 1)
        object.__setattr__(self, "covariance", as_array(self.covariance, (count, count), "covariance"))

    def index(self, name: str) -> int:
        """Return the position of the camera `name`; raises InputError that lists the names."""
        names = [c.name for c in self.cameras]
        if name not in names:
            raise InputError(f"rig: no camera is called '{name}'; there are {', '.join(names)}")
        return names.index(name)

    def cam2_from_cam1(self, name1: str, name2: str) -> Rigid3:
        """Return the motion from one camera to another."""
        first, second = self.cameras[self.index(name1)], self.cameras[self.index(name2)]
        return second.cam_from_rig @ first.cam_from_rig.inverse()

    def baseline_mm(self, name1: str, name2: str) -> tuple[float, float]:
        """Return the distance between the centres of two cameras and its standard deviation, mm.

        The deviation is that of the corners' noise and of how well the boards' squares were measured.
        """
        first, second = self.index(name1), self.index(name2)
        difference = self._centre(second) - self._centre(first)
        length = float(np.linalg.norm(difference))
        if length == 0.0:
            raise InputError(f"rig: cameras '{name1}' and '{name2}' have the same centre")
        row = np.zeros(len(self.covariance))
        for k, sign in ((first, -1.0), (second, 1.0)):
            if k > 0:
                row[self._mount(k)] += sign * (difference / length @ self._centre_jacobian(k))
        variance = float(row @ self.covariance @ row)
        return length, float(np.sqrt(max(variance, 0.0) + (length * self.scale_sigma) ** 2))

    def _mount(self, k: int) -> slice:
        first = sum(c.camera.parameters.size for c in self.cameras) + 6 * (k - 1)
        return slice(first, first + 6)

    def _centre(self, k: int) -> FloatArray:
        return self.cameras[k].cam_from_rig.inverse().translation_mm

    def _centre_jacobian(self, k: int) -> FloatArray:
        """Return d centre / d (w, dt) of c = -R^T t for R <- exp(w) R, t <- t + dt."""
        pose = self.cameras[k].cam_from_rig
        back = pose.rotation.T
        return np.concatenate([-back @ skew(pose.translation_mm), -back], axis=1)


def calibrate_rig(
    views: Mapping[str, Sequence[tuple[str, BoardView]]],
    sizes_px: Mapping[str, tuple[int, int]],
    *,
    model: str | Mapping[str, str] = "scaramuzza",
    degree: int | Mapping[str, int | None] | None = None,
    board: str = "flat",
    folds: int = FOLDS,
    progress: Progress = silent,
) -> RigCalibration:
    """Return the calibration of a rig.

    Parameters
    ----------
    views : camera name -> (frame, view) pairs; what was taken at the same moment has the same frame.
    sizes_px : camera name -> (width, height).
    model, degree : as for `calibrate`, one for all cameras or one for each.
    board : as for `calibrate`; a warped or released board keeps the shape that the cameras found alone, on
        average.
    folds : of each camera's cross-validation, 0 for none.

    Raises
    ------
    InputError
        Fewer than two cameras, or cameras that share no board in any frame.
    DegenerateError
        As for `calibrate`, with the name of the camera.
    """
    if len(views) < 2:
        raise InputError(f"rig: {len(views)} camera; a rig has at least two")
    single = []
    for i, (name, own) in enumerate(views.items()):
        progress("cameras", i, len(views))
        wanted = model if isinstance(model, str) else model[name]
        try:
            only = [view for _, view in own]
            size = degree[name] if isinstance(degree, Mapping) else degree
            single.append(calibrate(only, sizes_px[name], model=wanted, degree=size, board=board, folds=folds))
        except (InputError, DegenerateError) as error:
            raise type(error)(f"camera '{name}': {error}") from error
    progress("cameras", len(views), len(views))
    seen = [seen_by(own, result) for own, result in zip(views.values(), single, strict=True)]
    return _joint(list(views), seen, tuple(single), progress)


def _joint(
    names: list[str], seen: list[dict[Key, Seen]], single: tuple[Calibration, ...], progress: Progress
) -> RigCalibration:
    """Solve for everything together, leaving out boards on which the cameras disagree."""
    mounts = mounts_of(names, seen)
    seen = turned_alike(seen, mounts)
    left_out = _parted(seen, apart(seen, mounts, [result.camera for result in single]), FAR_APART)
    points = _board_points(single)
    for i in range(MAX_ROUNDS):
        progress("rig", i, MAX_ROUNDS)
        if left_out:
            _require_linked(names, seen, len(left_out))
        observations = RigObservations.from_views(
            [[(key, entry.view) for key, entry in s.items()] for s in seen],
            [[entry.kept for entry in s.values()] for s in seen],
            points,
        )
        start = RigState(
            tuple(result.camera for result in single),
            np.array([m.rotation for m in mounts]),
            np.array([m.translation_mm for m in mounts]),
            *first_frames(observations.keys, seen, mounts),
        )
        state, normal, convergence = solve_rig(observations, start)
        worse = _parted(seen, _excess_px(observations, normal, seen), DISAGREES) if i < MAX_ROUNDS - 1 else []
        left_out += worse
        if not worse:
            break
        mounts = [Rigid3(r, t) for r, t in zip(state.mount_rotation, state.mount_mm, strict=True)]
    progress("rig", MAX_ROUNDS, MAX_ROUNDS)
    result = _result(tuple(names), single, observations, state, normal, convergence)
    boards = {entry.view.board.board_id: entry.view.board for own in seen for entry in own.values()}.values()
    # One ruler has measured all of them: its error does not average out.
    scale_sigma = max((b.square_sigma_mm or 0.0) / min(b.square_x_mm, b.square_y_mm) for b in boards)
    return replace(result, shared_count=len(_shared(seen)), left_out=tuple(left_out), scale_sigma=scale_sigma)


def _require_linked(names: list[str], seen: list[dict[Key, Seen]], left_out: int) -> None:
    """Raise DegenerateError where so much was left out that a camera hangs together with no other."""
    try:
        mounts_of(names, seen)
    except InputError as error:
        raise DegenerateError(
            f"{error}; {left_out} boards were left out because the cameras disagree on them: check that the images of "
            "a frame were taken at one moment"
        ) from error


def _shared(seen: Sequence[Mapping[Key, Seen]]) -> set[Key]:
    """Return the boards that several cameras see at once."""
    count = Counter(key for own in seen for key in own)
    return {key for key, n in count.items() if n > 1}


def _excess_px(observations: RigObservations, normal: Normal, seen: Sequence[Mapping[Key, Seen]]) -> dict[Key, float]:
    """Return the 2-D RMS that every board in every frame has only because the cameras share its pose: a view that is
    bad in itself is no reason to distrust the moment."""
    excess, count = np.zeros(len(observations.keys)), np.zeros(len(observations.keys))
    for c, (r, frame) in enumerate(zip(normal.residuals, observations.frame, strict=True)):
        used = observations.weights[c] > 0.0
        alone = np.array([seen[c][observations.keys[f]].squared_px for f in frame])
        np.add.at(excess, frame, ((r.px**2).sum(axis=-1) * used).sum(axis=1) - alone)
        np.add.at(count, frame, used.sum(axis=1))
    rms = np.sqrt(np.maximum(excess, 0.0) / np.maximum(count, 1.0))
    return dict(zip(observations.keys, rms.tolist(), strict=True))


def _parted(seen: list[dict[Key, Seen]], off_px: Mapping[Key, float], limit: float) -> list[tuple[str, str, str]]:
    """Give every camera its own board where `off_px` is more than `limit` times the usual one; return which and why.

    `seen` is changed: the views stay, so that they support each camera's intrinsics.
    """
    shared = _shared(seen)
    usual = float(np.median([off_px[key] for key in shared])) if shared else 0.0
    # The worst ones first: they may be why the others look bad.
    worst = max((off_px[key] for key in shared), default=0.0)
    out = []
    for key in sorted(shared):
        if off_px[key] <= max(limit * max(usual, LEAST_PX), 0.5 * worst):
            continue
        for k, own in enumerate(seen):
            if key in own:
                own[(f"{key[0]}, camera {k + 1} alone", key[1])] = own.pop(key)
        reason = (
            f"the cameras disagree by {off_px[key]:.2g} px ({off_px[key] / max(usual, LEAST_PX):.1f} times the usual)"
        )
        out.append((*key, reason + "; the board or the rig moved between the exposures, or they are not of one moment"))
    return out


def _board_points(single: Sequence[Calibration]) -> dict[str, Points]:
    """Return the corners of every board, averaged over the cameras that have seen it."""
    points: dict[str, list[Points]] = {}
    for result in single:
        for board in result.boards:
            points.setdefault(board.board_id, []).append(board.points_mm)
    return {name: np.mean(found, axis=0) for name, found in points.items()}


def _result(
    names: tuple[str, ...],
    single: tuple[Calibration, ...],
    observations: RigObservations,
    state: RigState,
    normal: Normal,
    convergence: Convergence,
) -> RigCalibration:
    squared = [
        (r.px**2).sum(axis=-1)[weight > 0.0] for r, weight in zip(normal.residuals, observations.weights, strict=True)
    ]
    weighted = float(normal.costs.sum())
    everything = np.concatenate(squared)
    unknowns = sum(c.parameters.size for c in state.cameras) + 6 * (len(names) - 1 + len(observations.keys))
    freedom = 2 * everything.size - unknowns
    if freedom <= 0:
        raise DegenerateError("rig: fewer corners than unknowns; take more frames")
    sigma = float(np.sqrt(weighted / freedom))
    covariance = normal.covariance()[0] * sigma**2
    cameras = tuple(
        RigCamera(name, camera, Rigid3(r, t), float(np.sqrt(own.mean())))
        for name, camera, r, t, own in zip(
            names, state.cameras, state.mount_rotation, state.mount_mm, squared, strict=True
        )
    )
    rms_px = float(np.sqrt(everything.mean()))
    return RigCalibration(cameras, rms_px, covariance, sigma, single, convergence, everything.size)
