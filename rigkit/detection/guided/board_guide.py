"""Where the corners of a known board are to be expected, and how the lines through them run: what guides a second look.

A calibrated camera says it from the board's pose, corrected by what the corners around leave over (the model does not
quite follow the lens, the board is not quite flat); without a camera the corners around say it alone.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace

import cv2
import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.detection.lattice.local_fit import LocalFit, fit_cells
from rigkit.detection.stencil import STENCIL, by_differences
from rigkit.detection.subpixel.edge_fit import EdgeFit
from rigkit.geometry.board_pose import board_poses, ray_residuals
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

HALF_STEP = 0.4
"""Derivatives of the projection are chords of this many squares to either side: as far as the window reaches."""

MIN_GUIDE_CORNERS = 12
"""Corners found that a board must have to be a guide."""

MAX_GUIDE_GAIN = 4.0
"""Predictions from corners around count up to this standard deviation, for corners of standard deviation 1."""

CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
"""Without a camera a ring of corners is predicted at a time: the cells beside known ones."""

NEIGHBOURS_USED = 8
"""Corners by which one beside them is judged."""

POSE_CELLS = 0.06
POSE_PX = 1.5
"""A camera whose best pose of the board misses the corners by more than this (median; the larger of the two) did not
take the image: it is not asked."""

POSE_STEPS, POSE_SCALE = 5, 3.0
"""Gauss-Newton steps of the pose, and the scale of their Cauchy weights in medians of the misses."""

FITTED = ("pixels", "contrast", "residual", "noise", "sigma_px", "blur")
"""What `BoardState` holds of a fit, in its order."""

MAX_RESIDUAL_RATIO = 3.0
"""Corners with more than this times the usual standard deviation, which other things in their windows raise, say
nothing of their neighbours; nor does so much more excuse them."""


@dataclass(frozen=True, eq=False, slots=True)
class BoardState:
    """Corners of the board (R, C) with what the fit says of each, NaN where missing; contrast is positive.

    `together` : whether they were then placed together, as `placed_together` does; pixels and sigmas are of that.
    """

    pixels: FloatArray
    contrast: FloatArray
    residual: FloatArray
    noise: FloatArray
    sigma_px: FloatArray
    blur: FloatArray
    _: KW_ONLY
    signs: FloatArray
    together: bool = False

    @classmethod
    def unfitted(cls, pixels: FloatArray, signs: FloatArray) -> BoardState:
        """Return corners (R, C, 2) of which no fit has said anything yet."""
        nothing = np.full(pixels.shape[:2], np.nan)
        return cls(pixels, nothing, nothing, nothing, nothing, nothing, signs=signs)

    @property
    def known(self) -> BoolArray:
        return np.isfinite(self.pixels[..., 0])

    @property
    def typical_sigma(self) -> float:
        return known_median(self.sigma_px[self.known])

    def typical_near(self, cells: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return contrast and residual that are usual around each of the `cells` (R, C), (M,) each: light, blur and the
        squares' size differ over a board, in a shadow by as much as from one board to another."""
        row, column = np.nonzero(cells)
        known_row, known_column = np.nonzero(self.known & np.isfinite(self.residual))
        separation = (row[:, None] - known_row) ** 2 + (column[:, None] - known_column) ** 2
        nearest = np.argsort(separation, axis=1, kind="stable")[:, :NEIGHBOURS_USED]
        around = known_row[nearest], known_column[nearest]
        return np.median(self.contrast[around], axis=1), np.median(self.residual[around], axis=1)

    def with_fit(self, cells: BoolArray, fit: EdgeFit, good: BoolArray) -> BoardState:
        """Return the state with the `good` of the corners fitted at `cells` put in."""
        values, mine = self._copied(), good.nonzero()[0]
        where = cells.reshape(-1).nonzero()[0][mine]
        for value, name in zip(values, FITTED, strict=True):
            new = getattr(fit, name)
            value.reshape(-1, *new.shape[1:])[where] = new[mine]
        return BoardState(*values, signs=self.signs, together=self.together)

    def without(self, drop: BoolArray) -> BoardState:
        """Return the state with the corners `drop` (R, C) forgotten."""
        values = self._copied()
        for value in values:
            value[drop] = np.nan
        return BoardState(*values, signs=self.signs, together=self.together)

    def _copied(self) -> list[FloatArray]:
        """Return copies of what fits say of corners."""
        return [getattr(self, name).copy() for name in FITTED]


@dataclass(frozen=True, eq=False, slots=True)
class Guide:
    """Where the corners of a board are and how the lines through them run: from a camera, else from corners around."""

    board: Board
    camera: Camera | None
    cam_from_board: Rigid3 | None

    @classmethod
    def of(cls, board: Board, camera: Camera | None, state: BoardState) -> Guide:
        """Return the guide that the corners found give; without the camera where that cannot have seen them."""
        pose = None if camera is None else _pose(board, camera, state, None)
        return cls(board, None if pose is None else camera, pose)

    def by(self, state: BoardState) -> Guide:
        """Return the guide that the corners known now give."""
        if self.camera is None:
            return self
        pose = _pose(self.board, self.camera, state, self.cam_from_board)
        return Guide(self.board, None if pose is None else self.camera, pose)

    def at(self, state: BoardState, cells: BoolArray) -> tuple[LocalFit, BoolArray]:
        """Return the shape of the board at `cells` (R, C), and which of these M cells are predicted well enough."""
        if self.camera is None or self.cam_from_board is None:
            shape = fit_cells(state.pixels, cells, degree=3, ridge=(1e-3, 1e-2), leave_out=True)
            beside = cv2.dilate(state.known.astype(np.uint8), CROSS)[cells] > 0
            return shape, np.asarray(beside & (shape.support >= 6) & (shape.gain < MAX_GUIDE_GAIN))
        shape, valid = self._projected(self.camera, self.cam_from_board, cells)
        sound = state.known & (state.sigma_px < MAX_RESIDUAL_RATIO * state.typical_sigma)
        if sound.any():
            # What the lens model, or a board that is not flat, leaves over changes slowly from corner to corner.
            every = self._projected(self.camera, self.cam_from_board, sound)[0].pixels
            left = np.full(state.pixels.shape, np.nan)
            left[sound] = state.pixels[sound] - every
            rest = fit_cells(left, cells, degree=1, ridge=(1e-3, 1e-2), leave_out=True)
            near = ((rest.support >= 6) & (rest.gain < 1.0))[:, None]
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
    """Return the pose of the board, None where the camera cannot have seen it so; `start` is one nearby, if known."""
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
        # A corner that something covers in part must not turn the board: Cauchy weights.
        weight = 1.0 / (1.0 + (off / (POSE_SCALE * max(float(np.median(off)), 1e-6))) ** 2)
        weighted = (jacobian * weight[:, None, None]).reshape(-1, 6)
        step = np.linalg.lstsq(weighted.T @ jacobian.reshape(-1, 6), -weighted.T @ residual.ravel(), rcond=None)[0]
        rotation, translation = exp_so3(step[:3]) @ rotation, translation + step[3:]
    area = float(np.median(fit_cells(state.pixels, state.known, degree=1).areas()))
    side = np.sqrt(max(area, 1.0))
    if not float(np.median(off)) < max(POSE_PX, POSE_CELLS * side):
        return None
    return Rigid3(rotation, translation)
