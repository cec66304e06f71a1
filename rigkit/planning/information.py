"""The information of a view of a board about the camera, with the pose of the board eliminated.

With J_k and J_p the derivatives of a view's corners by camera and pose, it is I = J_k^T J_k - J_k^T J_p (J_p^T J_p)^-1
J_p^T J_k over the variance of a corner. The corners of one view have correlated errors, so n of them count like
n / (1 + (n - 1) rho) independent ones: the design effect of cluster sampling.

A board that cameras a and b see at once has the poses a_from_board and b_from_board, and b_from_a = b_from_board
board_from_a has the errors of both: its information about the mount, for known lenses. Frames are independent, so their
information adds up.

Before the first view a camera is guessed from nothing but the approximate field of view of its lens.

Reference: L. Kish, "Survey Sampling" (1965), section 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.certainty.displaced import LensModes, with_modes
from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.camera_prior import camera_prior
from rigkit.calibration.solving.clustered import reduced_by_cluster
from rigkit.calibration.solving.linearise import view_products
from rigkit.calibration.solving.shape import WARP_UNKNOWNS, ShapeModel, warp_of_board
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera, RadialCurve, image_center
from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Points, root_diagonal
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3, skew

LENS_UNKNOWN = 0.1
"""Standard deviation of the projection of a guessed lens, as a part of half the image's diagonal."""
PRIOR_GRID = (12, 9)
MIN_SIGMA_PX = 0.02
"""Least standard deviation of a real corner: with exact corners every view would have unlimited information."""
PERSPECTIVE_DEG = 100.0
"""Lenses with a smaller horizontal field of view are mostly rectilinear; wider ones are fisheyes."""
CURVE_RADII = 64
CURVE_END = 1.05
"""End of the radial curve, relative to the corner of the image."""
MAX_THETA_RAD = 3.0


@dataclass(frozen=True, slots=True)
class CornerError:
    """The error of a corner: its standard deviation per coordinate, px, and the correlation `rho` with the other
    corners of its view."""

    sigma_px: float
    rho: float = 0.0

    @classmethod
    def of(cls, calibration: Calibration) -> CornerError:
        """Return the error from the residuals of a calibration, with rho from their overdispersion."""
        corners = np.array([int(view.kept.sum()) for view in calibration.views])
        typical = float(corners[corners > 0].mean())
        excess = calibration.overdispersion**2 - 1.0
        rho = float(np.clip(excess / (typical - 1.0), 0.0, 1.0)) if typical > 1.0 else 0.0
        return cls(max(calibration.sigma_px, MIN_SIGMA_PX), rho)

    def variance(self, corners: FloatArray) -> FloatArray:
        """Return the effective variance of each corner in views with so many corners, px^2."""
        return np.asarray(self.sigma_px**2 * (1.0 + np.maximum(corners - 1.0, 0.0) * self.rho))


@dataclass(frozen=True, eq=False, slots=True)
class BoardPoses:
    """One board in C poses: cam_from_board as `rotation` (C, 3, 3) and `translation_mm` (C, 3), and the mask `seen`
    (C, N) of its N corners."""

    points_mm: Points
    rotation: FloatArray
    translation_mm: Points
    seen: BoolArray

    def __len__(self) -> int:
        return len(self.rotation)

    def pose(self, index: int) -> Rigid3:
        """Return cam_from_board of the pose at `index`."""
        return Rigid3(self.rotation[index], self.translation_mm[index])

    def chosen(self, index: IntArray | BoolArray) -> BoardPoses:
        """Return the poses at `index`."""
        return BoardPoses(self.points_mm, self.rotation[index], self.translation_mm[index], self.seen[index])

    def transformed(self, other_from_cam: Rigid3) -> BoardPoses:
        """Return the poses in another frame; `seen` is unchanged."""
        rotation, translation = other_from_cam.rotation @ self.rotation, other_from_cam.apply(self.translation_mm)
        return BoardPoses(self.points_mm, rotation, translation, self.seen)

    def in_cam(self, points_mm: Points) -> Points:
        """Return points (K, 3) of the board in the camera frame, (C, K, 3)."""
        return np.asarray(points_mm @ np.swapaxes(self.rotation, -1, -2) + self.translation_mm[:, None, :])


@dataclass(frozen=True, eq=False, slots=True)
class Knowledge:
    """Estimate of a camera, and its information.

    Attributes
    ----------
    camera : the estimate.
    information : (T, T) on its parameters, then on the warps of the boards that are not known to be flat.
    error : of a corner.
    warped : names of these boards.
    """

    camera: Camera
    information: FloatArray
    error: CornerError
    warped: tuple[str, ...] = ()

    @classmethod
    def guessed(cls, camera: Camera, error: CornerError) -> Knowledge:
        """Return the knowledge of a lens that is only roughly guessed."""
        return cls(camera, lens_prior(camera), error)

    @classmethod
    def unseen(cls, calibration: Calibration) -> Knowledge:
        """Return the knowledge of a calibrated lens without the information of its views."""
        camera = calibration.camera
        warped = [shape for shape in calibration.boards if shape.kind != "flat"]
        p = camera.parameters.size
        information = np.zeros((p + WARP_UNKNOWNS * len(warped),) * 2)
        information[:p, :p] = lens_prior(camera)
        sigma = np.concatenate([np.zeros(0), *(warp_of_board(shape.points_mm).sigma for shape in warped)])
        information[p:, p:] = np.diag(sigma**-2)
        return cls(camera, information, CornerError.of(calibration), tuple(shape.board_id for shape in warped))

    @classmethod
    def of(cls, calibration: Calibration) -> Knowledge:
        """Return the knowledge from the views of a calibration."""
        known = cls.unseen(calibration)
        for shape in calibration.boards:
            views = [v for v in calibration.views if v.board_id == shape.board_id and v.kept.any()]
            if not views:
                continue
            board, seen = shape.board, np.zeros((len(views), len(shape.points_mm)), dtype=bool)
            for row, view in zip(seen, views, strict=True):
                row[board.index(view.grid)[view.kept]] = True
            poses = [view.cam_from_board for view in views]
            held = BoardPoses(
                shape.points_mm,
                np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
                np.array([pose.translation_mm for pose in poses]).reshape(-1, 3),
                seen,
            )
            known = known.with_views(held, shape.board_id)
        return known

    def of_views(self, held: BoardPoses, board_id: str = "") -> FloatArray:
        """Return the information of each view of the board `board_id` in C poses, (C, T, T)."""
        camera, p = self.camera, self.camera.parameters.size
        out = np.zeros((len(held), *self.information.shape))
        if board_id not in self.warped:
            out[:, :p, :p] = view_information(camera, held, self.error)
            return out
        first = p + WARP_UNKNOWNS * self.warped.index(board_id)
        own = np.r_[0:p, first : first + WARP_UNKNOWNS]
        products = _products(camera, held, self.error, warp_of_board(held.points_mm))
        reduced = reduced_by_cluster(products, p + WARP_UNKNOWNS, np.arange(len(held)))[0]
        out[:, own[:, None], own] = reduced
        return out

    def with_model_inadequacy(self, modes: LensModes) -> Knowledge:
        """Return the same with the amounts of the model's inadequacy as further parameters, which new views also
        estimate."""
        p, count = self.camera.parameters.size, modes.modes.shape[1]
        (camera,), *_ = with_modes((self.camera,), np.zeros((p, p)), (modes,))
        # The information is that of n = x - moves a, with x the parameters and a amounts of variance one.
        back = np.zeros((len(self.information), len(self.information) + count))
        own, amounts = np.r_[0:p, p + count : back.shape[1]], np.arange(p, p + count)
        back[:, own] = np.eye(len(self.information))
        back[:p, amounts] = -modes.moves
        information = back.T @ self.information @ back
        information[amounts, amounts] += 1.0
        return replace(self, camera=camera, information=information)

    def with_views(self, held: BoardPoses, board_id: str = "") -> Knowledge:
        """Return the knowledge after these views are taken."""
        return replace(self, information=self.information + self.of_views(held, board_id).sum(axis=0))


def view_information(camera: Camera, held: BoardPoses, error: CornerError) -> FloatArray:
    """Return the information of each view of a board in C poses about the camera's parameters, (C, P, P)."""
    products = _products(camera, held, error)
    return reduced_by_cluster(products, camera.parameters.size, np.arange(len(products)))[0]


def pose_information(camera: Camera, held: BoardPoses, error: CornerError) -> FloatArray:
    """Return the information of each view of a board in C poses about that pose, for a known camera, (C, 6, 6): about
    a rotation around the board's origin (rad) and a translation (mm), in the camera frame."""
    p = camera.parameters.size
    return _products(camera, held, error)[:, p : p + 6, p : p + 6]


def _products(camera: Camera, held: BoardPoses, error: CornerError, shape: ShapeModel | None = None) -> FloatArray:
    corners = held.seen.shape[1]
    if shape is None:
        none = np.zeros(0, dtype=np.int64)
        shape = ShapeModel("flat", held.points_mm, np.zeros((corners, 3, 0)), np.zeros(0), none)
    state = State(camera, held.rotation, held.translation_mm, shape, np.zeros(len(shape.sigma)))
    weight = held.seen / np.sqrt(error.variance(held.seen.sum(axis=1, dtype=np.float64)))[:, None]
    return view_products(observations_of(held.seen), state, weight)


def observations_of(seen: BoolArray, boards: tuple[Board, ...] = ()) -> Observations:
    """Return observations of hypothetical views of one board; `seen` (C, N) is the mask of its corners in each."""
    views, corners = seen.shape
    return Observations(
        views=(),
        pixels=np.zeros((views, corners, 2)),
        corner=np.broadcast_to(np.arange(corners), seen.shape),
        sigma_px=np.ones(seen.shape),
        weight=seen.astype(np.float64),
        present=seen,
        boards=boards,
        first_row=np.array([0, corners]),
        board=np.zeros(views, dtype=np.int64),
    )


def lens_prior(camera: Camera) -> FloatArray:
    """Return the prior information (P, P) on any lens: square pixels, a roughly central axis, and a projection known to
    a tenth of half the image's diagonal. It is negligible compared with the views of a session."""
    rays, valid = camera.unproject(grid_pixels(camera.size_px, PRIOR_GRID).reshape(-1, 2))
    p = camera.parameters.size
    design = projection_design(camera, rays[valid])[:, :p]
    sigma = LENS_UNKNOWN * 0.5 * float(np.hypot(*camera.size_px))
    # All pixels together give the information of one observation per parameter.
    whole = np.einsum("ipm,iqm->pq", design, design) * p / (design[0, 0].size * sigma**2)
    rows, _ = camera_prior(camera)
    return np.asarray(whole + rows.T @ rows)


@dataclass(frozen=True, eq=False, slots=True)
class SharedViews:
    """C boards that cameras `a` and `b` see at once, posed in each camera, and the error of a corner."""

    a: Camera
    b: Camera
    in_a: BoardPoses
    in_b: BoardPoses
    error: CornerError

    def rotations_and_offsets(self) -> tuple[FloatArray, FloatArray]:
        """Return the rotations (C, 3, 3) of b_from_a, and the boards' origins in a rotated by them, (C, 3) mm."""
        turn = self.in_b.rotation @ np.swapaxes(self.in_a.rotation, -1, -2)
        return turn, np.einsum("cij,cj->ci", turn, self.in_a.translation_mm)


def mount_information(shared: SharedViews) -> FloatArray:
    """Return the information of each of C shared boards about b_from_a, (C, 6, 6): about a rotation around the origin
    of b (rad) and a translation (mm)."""
    turn, rotated = shared.rotations_and_offsets()
    by_a, by_b = np.zeros((len(turn), 6, 6)), np.zeros((len(turn), 6, 6))
    # With b_from_a = B A^-1, errors (w, v) of either pose, x -> exp(w) R x + t + v, make w = w_b - R_ba w_a and
    # v = v_b - R_ba v_a - w x (R_ba t_a).
    by_b[:, :3, :3] = by_b[:, 3:, 3:] = np.eye(3)
    by_b[:, 3:, :3] = skew(rotated)
    by_a[:, :3, :3] = by_a[:, 3:, 3:] = -turn
    by_a[:, 3:, :3] = -skew(rotated) @ turn
    covariance = by_a @ _inverse(pose_information(shared.a, shared.in_a, shared.error)) @ np.swapaxes(by_a, -1, -2)
    covariance += by_b @ _inverse(pose_information(shared.b, shared.in_b, shared.error)) @ np.swapaxes(by_b, -1, -2)
    return _inverse(covariance)


def mount_error_px(shared: SharedViews, information: FloatArray) -> FloatArray:
    """Return the rms error (...), px, of the boards' corners predicted in b from their poses in a, with the mount known
    from each of `information` (..., 6, 6)."""
    turn, lever = shared.rotations_and_offsets()
    # A rotation around the origin of b moves the board's origin, too.
    as_pose = np.tile(np.eye(6), (len(turn), 1, 1))
    as_pose[:, 3:, :3] = -skew(lever)
    unit = pose_information(shared.b, shared.in_b, CornerError(1.0))
    weight = np.swapaxes(as_pose, -1, -2) @ unit @ as_pose
    mean = weight.sum(axis=0) / float(shared.in_b.seen.sum())
    return np.asarray(np.sqrt(np.maximum(np.einsum("ij,...ji->...", mean, _inverse(information)), 0.0)))


def median_motion(motions: Sequence[Rigid3]) -> Rigid3:
    """Return the componentwise medians of similar motions: of rotations relative to the first, and of translations."""
    first = motions[0]
    turns = np.array([log_so3(m.rotation @ first.rotation.T) for m in motions])
    shifts = np.array([m.translation_mm for m in motions])
    return Rigid3(exp_so3(np.median(turns, axis=0)) @ first.rotation, np.median(shifts, axis=0))


def _inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of matrices (..., 6, 6), scaled first: radians and millimetres differ in magnitude."""
    scale = 1.0 / root_diagonal(matrices)
    unit = matrices * scale[..., :, None] * scale[..., None, :]
    return np.asarray(np.linalg.pinv(unit, hermitian=True) * scale[..., :, None] * scale[..., None, :])


def check_field(hfov_deg: float) -> None:
    """Raise InputError for an impossible horizontal field of view."""
    if not 0.5 <= hfov_deg <= 300.0:
        raise InputError(f"a lens of {hfov_deg:g} degrees: give the field of view across the image's width, 0.5 to 300")


def guessed_camera(hfov_deg: float, size_px: tuple[int, int], model: str | None = None) -> Camera:
    """Return a camera with a horizontal field of view of `hfov_deg`: perspective below 100 degrees, else equidistant;
    of `model`, by default Brown's or Kannala and Brandt's.

    Raises InputError for an impossible angle, or a model that cannot represent it.
    """
    check_field(hfov_deg)
    half_px, half_rad = 0.5 * size_px[0], np.radians(0.5 * hfov_deg)
    straight = hfov_deg < PERSPECTIVE_DEG
    corner_px = CURVE_END * 0.5 * float(np.hypot(*size_px))
    if straight:
        focal = half_px / np.tan(half_rad)
        theta = np.linspace(0.0, np.arctan(corner_px / focal), CURVE_RADII)
        radius = focal * np.tan(theta)
    else:
        focal = half_px / half_rad
        theta = np.linspace(0.0, min(corner_px / focal, MAX_THETA_RAD), CURVE_RADII)
        radius = focal * theta
    kind = camera_model(model or ("brown" if straight else "kannala_brandt"))
    return kind.from_radial_curve(size_px, RadialCurve(image_center(size_px), theta, radius))
