"""Several cameras on one mount, from synchronous views of boards: all intrinsics and all mounts solved together.

The rig's frame is that of its first camera. Not every camera need see every board in every frame: it is enough that the
cameras hang together through boards that two of them see at once. A frame in which several boards are seen counts each
board on its own; the boards may move between frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.arrays import FloatArray, Mat3, Points, as_array
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration, Convergence
from rigkit.calibration.rig_solver import RigObservations, RigState, rig_normal, rig_residuals, solve_rig
from rigkit.cameras.base import Camera
from rigkit.detections import BoardView
from rigkit.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation, skew
from rigkit.progress import Progress, silent

__all__ = ["RigCalibration", "RigCamera", "calibrate_rig"]


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
    """

    cameras: tuple[RigCamera, ...]
    rms_px: float
    covariance: FloatArray
    sigma_px: float
    single: tuple[Calibration, ...]
    convergence: Convergence

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
        """Return the distance between the centres of two cameras and its standard deviation, mm."""
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
        return length, max(variance, 0.0) ** 0.5

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
    degree: int | None = None,
    board: str = "flat",
    progress: Progress = silent,
) -> RigCalibration:
    """Return the calibration of a rig.

    Parameters
    ----------
    views : camera name -> (frame, view) pairs; what was taken at the same moment has the same frame.
    sizes_px : camera name -> (width, height).
    model : one camera model for all, or one for each.
    degree, board : as for `calibrate`; a warped or released board keeps the shape that the cameras found alone, on
        average.

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
            single.append(calibrate(only, sizes_px[name], model=wanted, degree=degree, board=board))
        except (InputError, DegenerateError) as error:
            raise type(error)(f"camera '{name}': {error}") from error
    progress("cameras", len(views), len(views))
    seen = [_kept_views(own, result) for own, result in zip(views.values(), single, strict=True)]
    mounts = _mounts(list(views), seen)
    observations = RigObservations.from_views(
        [[(key, entry.view) for key, entry in s.items()] for s in seen],
        [[entry.kept for entry in s.values()] for s in seen],
        _board_points(single),
    )
    start = RigState(
        tuple(result.camera for result in single),
        np.array([m.rotation for m in mounts]),
        np.array([m.translation_mm for m in mounts]),
        *_frames(observations.keys, seen, mounts),
    )
    state, convergence = solve_rig(observations, start)
    return _result(tuple(views), tuple(single), observations, state, convergence)


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    view: BoardView
    kept: np.ndarray
    cam_from_board: Rigid3


_Key = tuple[str, str]


def _kept_views(own: Sequence[tuple[str, BoardView]], result: Calibration) -> dict[_Key, _Seen]:
    """Return the views that the camera's own calibration used, by (frame, board)."""
    used = {(v.image, v.board_id): v for v in result.views}
    out = {}
    for frame, view in own:
        entry = used.get((view.image, view.board.board_id))
        if entry is not None:
            out[(frame, view.board.board_id)] = _Seen(view, entry.kept, entry.cam_from_board)
    return out


def _mounts(names: list[str], seen: list[dict[_Key, _Seen]]) -> list[Rigid3]:
    """Return cam_from_rig of every camera, along a tree of pairs that share the most boards."""
    mounts: dict[int, Rigid3] = {0: Rigid3.identity()}
    shared = {(i, j): sorted(seen[i].keys() & seen[j].keys()) for i in range(len(seen)) for j in range(len(seen))}
    while len(mounts) < len(seen):
        i, j = max(((i, j) for i in mounts for j in range(len(seen)) if j not in mounts), key=lambda e: len(shared[e]))
        if not shared[i, j]:
            raise InputError(
                f"rig: camera '{names[j]}' shares no board in any frame with '{names[0]}' or the cameras that hang "
                "together with it; take frames in which both see a board, and check the names of the frames"
            )
        pairs = [seen[j][key].cam_from_board @ seen[i][key].cam_from_board.inverse() for key in shared[i, j]]
        mounts[j] = _median(pairs) @ mounts[i]
    return [mounts[k] for k in range(len(seen))]


def _median(poses: Sequence[Rigid3]) -> Rigid3:
    """Return a pose in the middle of the poses: entries' medians, made a rotation again."""
    rotation = nearest_rotation(np.median([p.rotation for p in poses], axis=0))
    return Rigid3(rotation, np.median([p.translation_mm for p in poses], axis=0))


def _frames(keys: Sequence[_Key], seen: list[dict[_Key, _Seen]], mounts: list[Rigid3]) -> tuple[Mat3, Points]:
    """Return rig_from_board of every (frame, board), from the camera that sees most of its corners."""
    rotation, translation = [], []
    for key in keys:
        k = max((k for k in range(len(seen)) if key in seen[k]), key=lambda k: int(seen[k][key].kept.sum()))
        pose = mounts[k].inverse() @ seen[k][key].cam_from_board
        rotation.append(pose.rotation)
        translation.append(pose.translation_mm)
    return np.array(rotation), np.array(translation)


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
    convergence: Convergence,
) -> RigCalibration:
    residuals = rig_residuals(observations, state)
    squared = [(r.px**2).sum(axis=-1)[weight > 0.0] for r, weight in zip(residuals, observations.weights, strict=True)]
    weighted = sum(
        float(((r.px**2).sum(axis=-1) * weight**2).sum())
        for r, weight in zip(residuals, observations.weights, strict=True)
    )
    everything = np.concatenate(squared)
    unknowns = sum(c.parameters.size for c in state.cameras) + 6 * (len(names) - 1 + len(observations.keys))
    freedom = 2 * everything.size - unknowns
    if freedom <= 0:
        raise DegenerateError("rig: fewer corners than unknowns; take more frames")
    sigma = float(np.sqrt(weighted / freedom))
    covariance = rig_normal(observations, state).covariance()[0] * sigma**2
    cameras = tuple(
        RigCamera(name, camera, Rigid3(r, t), float(np.sqrt(own.mean())))
        for name, camera, r, t, own in zip(
            names, state.cameras, state.mount_rotation, state.mount_mm, squared, strict=True
        )
    )
    rms_px = float(np.sqrt(everything.mean()))
    return RigCalibration(cameras, rms_px, covariance, sigma, single, convergence)
