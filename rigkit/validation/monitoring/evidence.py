"""The evidence of fresh views of boards about a camera or a rig: information matrix and score of all parameters.

theta are the intrinsics of all cameras, the mounts of all but the first, then the warps of boards that the calibration
solved for: a board of another aspect ratio passes for another lens, so both are wrong together. Every board in every
frame has its own pose, common to all cameras that see it in the frame, and eliminated. A change d of theta gives scores
of mean I d.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rigkit.calibration.certainty.displaced import lens_of
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.calibration.rig.solving.pose_jacobians import pose_jacobians_of_mount, summed_products
from rigkit.calibration.solving.clustered import reduced_by_cluster
from rigkit.calibration.solving.linearise import view_products
from rigkit.calibration.solving.outliers import inliers, sigma_of
from rigkit.calibration.solving.poses import refine_poses
from rigkit.calibration.solving.shape import NONE, WARP_UNKNOWNS, ShapeModel, warp_of_board
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.cameras.moving_pupil import far_camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Points
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.planning.information import MIN_SIGMA_PX, observations_of

SAME_BOARD = 0.02
"""As a part of the board's size: a board whose stated corners differ by more from those of the calibration's board of
the same name is another board."""
POSE_ROUNDS = 3
"""Gauss-Newton steps of a board that several cameras see, starting from the view with most corners."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Monitored:
    """The camera or rig to check.

    Attributes
    ----------
    names, cameras, cam_from_rig : of one camera or of all cameras of a rig, whose frame is that of the first. Cameras
        take points in mm; a `NearCamera` has a moving pupil. The parameters of a camera are those of the model, then
        those of the model's inadequacy (`rigkit.calibration.certainty.displaced`), then those of the pupil.
    covariance : (T, T) of the errors of theta about zero.
    expected : (T, T) part of the covariance from errors whose mean is not zero: the products of the means; None: all
        means are zero.
    sigma_px, overdispersion : standard deviation of a corner, and the factor by which images disagree more than
        independent corners would.
    scale_sigma : relative standard deviation of all lengths, from the tolerance of the boards' squares; 0 where not
        stated.
    freedom : degrees of freedom of the covariance.
    boards_mm : corners (N, 3) of boards, by name, as calibrated; other boards, also of the same name, are as stated.
    warped : names of the boards whose warps theta contains.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cam_from_rig: tuple[Rigid3, ...]
    covariance: FloatArray
    sigma_px: float
    overdispersion: float = 1.0
    freedom: float = float("inf")
    scale_sigma: float = 0.0
    expected: FloatArray | None = None
    boards_mm: Mapping[str, Points] = field(default_factory=dict)
    warped: tuple[str, ...] = ()

    @property
    def mean_products(self) -> FloatArray:
        """`expected`, zeros for None."""
        return np.zeros_like(self.covariance) if self.expected is None else self.expected

    @property
    def is_rig(self) -> bool:
        """Whether there are several cameras."""
        return len(self.cameras) > 1

    @property
    def fresh_sigma_px(self) -> float:
        """Standard deviation of a corner in fresh views, overdispersion included. A factor below 1 is chance, and is
        not used."""
        return max(self.sigma_px, MIN_SIGMA_PX) * max(self.overdispersion, 1.0)

    @property
    def layout(self) -> Layout:
        """Indices of lenses, mounts and warps in theta."""
        return Layout.of([c.parameters.size for c in self.cameras], (), WARP_UNKNOWNS * len(self.warped))

    @property
    def of_models(self) -> IntArray:
        """Indices in theta of the parameters of the lens models and of the mounts."""
        layout = self.layout
        others = np.zeros(layout.count, dtype=bool)
        others[layout.shape] = True
        for camera, own in zip(self.cameras, layout.cameras, strict=True):
            others[own.start + lens_of(far_camera(camera)).parameters.size : own.stop] = True
        return np.flatnonzero(~others)

    def state(self, c: int, observations: Observations, rotation: FloatArray, translation_mm: Points) -> State:
        """Return camera `c` with boards in these poses, in their calibrated shapes where known."""
        each = [self._shape(board) for board in observations.boards]
        points, basis = (np.concatenate(parts) for parts in zip(*each, strict=True))
        unknowns = np.zeros(basis.shape[-1])
        return State(
            self.cameras[c], rotation, translation_mm, ShapeModel("warp", points, basis, unknowns, NONE), unknowns
        )

    def _shape(self, board: Board) -> tuple[Points, FloatArray]:
        """Return the corners (N, 3) of a board, and their derivatives (N, 3, B) by all warps."""
        found, points = self.boards_mm.get(board.board_id), board.points()
        basis = np.zeros((*points.shape, WARP_UNKNOWNS * len(self.warped)))
        if found is None or found.shape != points.shape:
            return points, basis
        if np.abs(found - points).max() >= SAME_BOARD * min(board.squares_mm) * max(board.size):
            return points, basis
        if board.board_id in self.warped:
            first = WARP_UNKNOWNS * self.warped.index(board.board_id)
            basis[..., first : first + WARP_UNKNOWNS] = warp_of_board(found).basis
        return found, basis

    def changed(self, change: FloatArray) -> Monitored:
        """Return cameras, mounts and boards after a change (T,) of theta."""
        layout = self.layout
        cameras = [
            c.with_parameters(c.parameters + change[own]) for c, own in zip(self.cameras, layout.cameras, strict=True)
        ]
        mounts = [
            pose if own is None else pose.moved(change[own])
            for pose, own in zip(self.cam_from_rig, layout.mounts, strict=True)
        ]
        boards = dict(self.boards_mm)
        for name, warp in zip(self.warped, change[layout.shape].reshape(-1, WARP_UNKNOWNS), strict=True):
            boards[name] = boards[name] + warp_of_board(boards[name]).basis @ warp
        return replace(self, cameras=tuple(cameras), cam_from_rig=tuple(mounts), boards_mm=boards)


@dataclass(frozen=True, eq=False, slots=True)
class FreshView:
    """A board seen by the camera of index `camera` in a frame: all views of a rig at one moment."""

    frame: str
    camera: int
    view: BoardView


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class FreshEvidence:
    """The evidence of N frames: information (N, T, T) and score (N, T) in px^2, the variance (px^2) of the scores
    where nothing changed, the rms of the residuals of the `corners` kept, its expectation `expected_px`, and the number
    of corners `left_out`. The variance includes the `overdispersion` (a ratio of standard deviations, with `freedom`
    degrees of freedom) of images, or parts of them, relative to independent corners."""

    information: FloatArray
    score: FloatArray
    variance_px2: float
    rms_px: float
    expected_px: float
    corners: int
    left_out: int
    overdispersion: float
    freedom: float


def evidence_of(monitored: Monitored, views: Sequence[FreshView]) -> FreshEvidence:
    """Return the evidence of fresh views about theta.

    Raises InputError without views, DegenerateError where the pose of a board cannot be found.
    """
    if not views:
        raise InputError("check: no board was found in the pictures; take sharp ones in which the whole board is seen")
    found = _PosedBoards.of(monitored, views)
    for _ in range(POSE_ROUNDS):
        products = found.products(monitored)
        n = monitored.layout.count
        # Where nearly all corners of a board are outliers, the pose is not determined: the pseudoinverse keeps it.
        inverse = np.linalg.pinv(products[:, n : n + 6, n : n + 6], hermitian=True)
        step = (inverse @ products[:, n : n + 6, -1:])[..., 0]
        found = found.moved(np.asarray(step, dtype=np.float64))
    information, score = reduced_by_cluster(found.products(monitored), monitored.layout.count, found.frame)
    squares, count, left_out = found.residual_squares(monitored)
    sigma = monitored.fresh_sigma_px
    return FreshEvidence(
        information=information,
        score=score,
        variance_px2=sigma**2,
        rms_px=float(np.sqrt(squares / count)),
        expected_px=float(np.sqrt(2.0) * sigma),
        corners=count,
        left_out=left_out,
        overdispersion=monitored.overdispersion,
        freedom=monitored.freedom,
    )


def board_information(
    monitored: Monitored, board: Board, rotation: FloatArray, translation_mm: Points, seen: Sequence[BoolArray]
) -> FloatArray:
    """Return the information about theta of each of C frames, (C, T, T) in px^2, as in `FreshEvidence`.

    A frame is `board` in the pose rig_from_board, `rotation` (C, 3, 3) and `translation_mm` (C, 3); `seen` has the
    corners that each camera sees, (C, N).
    """
    frames = np.arange(len(rotation))
    observations = tuple(observations_of(own, (board,)) for own in seen)
    placed = _PosedBoards(
        rotation, translation_mm, frames, observations, (frames,) * len(seen), tuple(o.weight for o in observations)
    )
    return reduced_by_cluster(placed.products(monitored), monitored.layout.count, frames)[0]


@dataclass(frozen=True, eq=False, slots=True)
class _PosedBoards:
    """G boards in frames, each with its pose rig_from_board and the index of its frame; for each camera its
    observations, the index of the board of each, and the weights, 0 for outliers."""

    rotation: FloatArray
    translation_mm: FloatArray
    frame: IntArray
    observations: tuple[Observations | None, ...]
    group: tuple[IntArray, ...]
    weight: tuple[FloatArray, ...]

    @classmethod
    def of(cls, monitored: Monitored, views: Sequence[FreshView]) -> _PosedBoards:
        keys = list(dict.fromkeys((v.frame, v.view.board.board_id) for v in views))
        number = {key: k for k, key in enumerate(keys)}
        frames = {name: k for k, name in enumerate(dict.fromkeys(frame for frame, _ in keys))}
        rotation, translation = np.tile(np.eye(3), (len(keys), 1, 1)), np.zeros((len(keys), 3))
        most = np.zeros(len(keys), dtype=np.int64)
        observations: list[Observations | None] = []
        groups, weights = [], []
        for c, pose in enumerate(monitored.cam_from_rig):
            own = [v for v in views if v.camera == c]
            group = np.array([number[v.frame, v.view.board.board_id] for v in own], dtype=np.int64)
            groups.append(group)
            if not own:
                observations.append(None)
                weights.append(np.zeros((0, 0)))
                continue
            seen = Observations.from_views([v.view for v in own])
            state, weight = _fit_board_poses(monitored, c, seen)
            back = pose.inverse()
            for k, g in enumerate(group.tolist()):
                if seen.present[k].sum() > most[g]:
                    most[g] = seen.present[k].sum()
                    rotation[g] = back.rotation @ state.rotation[k]
                    translation[g] = back.apply(state.translation_mm[k])
            observations.append(seen)
            weights.append(weight)
        frame = np.array([frames[name] for name, _ in keys], dtype=np.int64)
        return cls(rotation, translation, frame, tuple(observations), tuple(groups), tuple(weights))

    def state(self, monitored: Monitored, c: int, observations: Observations) -> State:
        """Return camera `c` with its boards, posed by their poses in the rig."""
        pose, group = monitored.cam_from_rig[c], self.group[c]
        rotation = pose.rotation @ self.rotation[group]
        translation = self.translation_mm[group] @ pose.rotation.T + pose.translation_mm
        return monitored.state(c, observations, rotation, translation)

    def products(self, monitored: Monitored) -> FloatArray:
        """Return for each board in a frame the sums of products of its rows, (G, T + 7, T + 7): derivatives by theta
        and by its pose in the rig, and the residual."""
        layout, each = monitored.layout, []
        for c, (seen, pose, lens) in enumerate(
            zip(self.observations, monitored.cam_from_rig, layout.cameras, strict=True)
        ):
            if seen is not None:
                own = view_products(seen, self.state(monitored, c, seen), self.weight[c])
                lever = self.translation_mm[self.group[c]] @ pose.rotation.T
                follow = pose_jacobians_of_mount(pose.rotation, layout.mounts[c], self.group[c], lever)
                theta = np.r_[lens.start : lens.stop, layout.shape.start : layout.shape.stop]
                each.append((own, theta, (follow,)))
        return summed_products(each, len(self.frame), layout.count)

    def moved(self, step: FloatArray) -> _PosedBoards:
        """Return the boards after steps (G, 6) of their poses."""
        rotation = exp_so3(step[:, :3]) @ self.rotation
        return replace(self, rotation=rotation, translation_mm=self.translation_mm + step[:, 3:])

    def residual_squares(self, monitored: Monitored) -> tuple[float, int, int]:
        """Return the sum of squared residuals of the inliers, px^2, the number of inliers, and of outliers."""
        total, kept, left = 0.0, 0, 0
        for c, seen in enumerate(self.observations):
            if seen is not None:
                used = self.weight[c] > 0.0
                total += float((evaluate(self.state(monitored, c, seen), seen).px[used] ** 2).sum())
                kept, left = kept + int(used.sum()), left + int((seen.present & ~used).sum())
        return total, max(kept, 1), left


def _fit_board_poses(monitored: Monitored, c: int, observations: Observations) -> tuple[State, FloatArray]:
    """Return every board in the pose that fits its view by camera `c` best, and the weights of its corners, zero for
    outliers."""
    camera, poses = monitored.cameras[c], []
    for view in observations.views:
        try:
            poses.append(cam_from_seen_board(camera, view.pixels, view.points()))
        except DegenerateError as error:
            raise DegenerateError(
                f"image '{view.image}': the lens does not see where board '{view.board.board_id}' is; "
                "check the board's size"
            ) from error
    rotation = np.array([pose.rotation for pose in poses])
    translation = np.array([pose.translation_mm for pose in poses])
    state = monitored.state(c, observations, rotation, translation)
    state, _ = refine_poses(observations, state, observations.weight)
    norm = evaluate(state, observations).weighted(observations)
    kept = inliers(norm, observations, sigma_of(norm, observations.present), camera.size_px)
    weight = np.where(kept, observations.weight, 0.0)
    return refine_poses(observations, state, weight)[0], weight
