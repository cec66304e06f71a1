"""Predictions of the corners of a known board and of the lines through them.

With a calibrated camera they follow from the board's pose, corrected by the residuals of neighbouring corners (due to
errors of the lens model or a board that is not flat); without a camera from neighbouring corners only.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace

import cv2
import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.detection.lattice.local_fit import FLEXIBLE, MIN_PREDICTORS, LocalFit, fit_cells
from rigkit.detection.stencil import STENCIL, by_differences
from rigkit.detection.subpixel.edge_fit import EdgeFit
from rigkit.geometry.board_pose import board_poses, ray_residuals
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

HALF_STEP = 0.4
"""Step, in squares, of the differences of the projection: about the size of the window."""

MIN_GUIDE_CORNERS = 12
"""Smallest number of detected corners of a board for its pose, and for predictions."""

MAX_GUIDE_GAIN = 4.0
"""Largest standard deviation of a prediction from neighbouring corners of standard deviation 1."""

CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
"""Neighbourhood of known corners in which corners are predicted without a camera, a ring at a time."""

NEIGHBOURS_USED = 8
"""Number of neighbours that give the typical contrast and residual of a corner."""

POSE_CELLS = 0.06
POSE_PX = 1.5
"""Largest median residual of the best pose of the board, in cells or (the larger) px: with a larger one the camera did
not take the image and is not used."""

POSE_STEPS, POSE_SCALE = 5, 3.0
"""Gauss-Newton steps of the pose, and the scale of their Cauchy weights in median residuals."""

FITTED = ("pixels", "contrast", "residual", "noise", "sigma_px", "blur")
"""Fields of `BoardState` from a fit, in order."""

MAX_RESIDUAL_RATIO = 3.0
"""Corners with more than this times the median standard deviation, due to other structures in their windows, are not
used to predict others, and the tolerance of corners is limited to that standard deviation."""


@dataclass(frozen=True, eq=False, slots=True)
class BoardState:
    """Corners of the board (R, C) with the results of their fits, NaN where missing; contrast is positive.

    `jointly` : whether pixels and sigmas are those of a joint fit (`placed_together`).
    """

    pixels: FloatArray
    contrast: FloatArray
    residual: FloatArray
    noise: FloatArray
    sigma_px: FloatArray
    blur: FloatArray
    _: KW_ONLY
    signs: FloatArray
    jointly: bool = False

    @classmethod
    def unfitted(cls, pixels: FloatArray, signs: FloatArray) -> BoardState:
        """Return corners (R, C, 2) without fit results."""
        nothing = np.full(pixels.shape[:2], np.nan)
        return cls(pixels, nothing, nothing, nothing, nothing, nothing, signs=signs)

    @property
    def known(self) -> BoolArray:
        return np.isfinite(self.pixels[..., 0])

    @property
    def typical_sigma(self) -> float:
        return known_median(self.sigma_px[self.known])

    def typical_near(self, cells: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return median contrast, residual and sigma of the neighbours of each of the `cells` (R, C), (M,) each: light,
        blur and size of the squares vary over a board."""
        row, column = np.nonzero(cells)
        known_row, known_column = np.nonzero(self.known & np.isfinite(self.residual))
        separation = (row[:, None] - known_row) ** 2 + (column[:, None] - known_column) ** 2
        nearest = np.argsort(separation, axis=1, kind="stable")[:, :NEIGHBOURS_USED]
        around = known_row[nearest], known_column[nearest]
        contrast, residual, sigma = (
            np.median(values[around], axis=1) for values in (self.contrast, self.residual, self.sigma_px)
        )
        return contrast, residual, sigma

    def with_fit(self, cells: BoolArray, fit: EdgeFit, good: BoolArray) -> BoardState:
        """Return the state with the `good` ones of the corners fitted at `cells`."""
        values, mine = self._copied(), good.nonzero()[0]
        where = cells.reshape(-1).nonzero()[0][mine]
        for value, name in zip(values, FITTED, strict=True):
            new = getattr(fit, name)
            value.reshape(-1, *new.shape[1:])[where] = new[mine]
        return BoardState(*values, signs=self.signs, jointly=self.jointly)

    def without(self, drop: BoolArray) -> BoardState:
        """Return the state without the corners `drop` (R, C)."""
        values = self._copied()
        for value in values:
            value[drop] = np.nan
        return BoardState(*values, signs=self.signs, jointly=self.jointly)

    def _copied(self) -> list[FloatArray]:
        """Return copies of the fields FITTED."""
        return [getattr(self, name).copy() for name in FITTED]


@dataclass(frozen=True, eq=False, slots=True)
class Guide:
    """Predicts the corners of a board and the lines through them, with a camera or from neighbouring corners."""

    board: Board
    camera: Camera | None
    cam_from_board: Rigid3 | None

    @classmethod
    def of(cls, board: Board, camera: Camera | None, state: BoardState) -> Guide:
        """Return the guide from the detected corners, without the camera if no pose of the board fits them."""
        pose = None if camera is None else _pose(board, camera, state, None)
        return cls(board, None if pose is None else camera, pose)

    def by(self, state: BoardState) -> Guide:
        """Return the guide from the corners known now."""
        if self.camera is None:
            return self
        pose = _pose(self.board, self.camera, state, self.cam_from_board)
        return Guide(self.board, None if pose is None else self.camera, pose)

    def at(self, state: BoardState, cells: BoolArray) -> tuple[LocalFit, BoolArray]:
        """Return the local geometry at the M `cells` (R, C), and which of them are predicted well enough."""
        if self.camera is None or self.cam_from_board is None:
            shape = fit_cells(state.pixels, cells, **FLEXIBLE._asdict(), leave_out=True)
            adjacent = cv2.dilate(state.known.astype(np.uint8), CROSS)[cells] > 0
            return shape, np.asarray(adjacent & (shape.support >= MIN_PREDICTORS) & (shape.gain < MAX_GUIDE_GAIN))
        shape, valid = self._projected(self.camera, self.cam_from_board, cells)
        sound = state.known & (state.sigma_px < MAX_RESIDUAL_RATIO * state.typical_sigma)
        if sound.any():
            # Residuals due to the lens model, or to a board that is not flat, vary slowly over the board.
            every = self._projected(self.camera, self.cam_from_board, sound)[0].pixels
            left = np.full(state.pixels.shape, np.nan)
            left[sound] = state.pixels[sound] - every
            rest = fit_cells(left, cells, degree=1, leave_out=True)
            near = ((rest.support >= MIN_PREDICTORS) & (rest.gain < 1.0))[:, None]
            gain = np.where(near[:, 0], np.hypot(1.0, rest.gain), 1.0)
            shape = replace(shape, pixels=shape.pixels + np.where(near, rest.pixels, 0.0), gain=gain)
        return shape, valid

    def _projected(self, camera: Camera, cam_from_board: Rigid3, cells: BoolArray) -> tuple[LocalFit, BoolArray]:
        row, column = np.nonzero(cells)
        grid = np.stack([column, row], axis=-1) + HALF_STEP * STENCIL[:, None]
        side = np.array([self.board.square_x_mm, self.board.square_y_mm])
        points = np.concatenate([grid * side, np.zeros((*grid.shape[:2], 1))], axis=2)
        pixels, valid = camera.project(cam_from_board.apply(points))
        ones = np.ones(len(row))
        return LocalFit(*by_differences(pixels, HALF_STEP), ones, ones), np.asarray(valid.all(axis=0))


def _pose(board: Board, camera: Camera, state: BoardState, start: Rigid3 | None) -> Rigid3 | None:
    """Return the robust pose of the board, None if none fits; `start` is an initial pose, if known."""
    row, column = np.nonzero(state.known)
    pixels = state.pixels[row, column]
    rays, seen = camera.unproject(pixels)
    if seen.sum() < MIN_GUIDE_CORNERS:
        return None
    rays, points = rays[seen], board.points(np.stack([column, row], axis=-1)[seen])
    bases = np.asarray(np.linalg.pinv(camera.ray_jacobian(pixels[seen])), dtype=np.float64)
    if start is None:
        try:
            start = board_poses(rays, points, bases=bases)[0].cam_from_board
        except DegenerateError:
            return None
    rotation, translation = start.rotation, start.translation_mm
    for _ in range(POSE_STEPS):
        residual, jacobian = ray_residuals(rays, bases, points, rotation, translation)
        off = np.linalg.norm(residual, axis=1)
        # Cauchy weights, for partly covered corners.
        weight = 1.0 / (1.0 + (off / (POSE_SCALE * max(float(np.median(off)), 1e-6))) ** 2)
        weighted = (jacobian * weight[:, None, None]).reshape(-1, 6)
        step = np.linalg.lstsq(weighted.T @ jacobian.reshape(-1, 6), -weighted.T @ residual.ravel(), rcond=None)[0]
        rotation, translation = exp_so3(step[:3]) @ rotation, translation + step[3:]
    area = float(np.median(fit_cells(state.pixels, state.known, degree=1).areas()))
    side = np.sqrt(max(area, 1.0))
    if not float(np.median(off)) < max(POSE_PX, POSE_CELLS * side):
        return None
    return Rigid3(rotation, translation)
