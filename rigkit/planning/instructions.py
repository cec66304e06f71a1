"""The pose of a board as an instruction for a person: "top edge, 40 cm away, tilted 35 degrees, left side nearer"."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels
from rigkit.core.boards import Board
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import unit
from rigkit.planning.candidates import outline_mm

MIDDLE_THIRD = (0.38, 0.62)
FACING_DEG = 8.0
NEARER_SIDES = ("right side", "lower right corner", "lower side", "lower left corner", "left side", "upper left corner",
         "upper side", "upper right corner")  # fmt: skip
"""Every 45 degrees in the image, clockwise from the right."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class BoardInView:
    """The pose of a board as a person sees it.

    Attributes
    ----------
    place : in the image, such as "top right corner".
    distance_mm : of the board's centre from the camera.
    tilt_deg : between the board's normal and the line of sight to its centre.
    nearer : the side of the board that is nearer to the camera; "" where it faces the camera.
    upright : whether its longer side is vertical in the image.
    outline_px : (K, 2) outline of its squares in the image; NaN outside the field of view.
    """

    place: str
    distance_mm: float
    tilt_deg: float
    nearer: str
    upright: bool
    outline_px: Pixels

    def __str__(self) -> str:
        tilt = (
            f"tilted {5.0 * round(self.tilt_deg / 5.0):.0f} degrees, {self.nearer} nearer" if self.nearer else "facing"
        )
        return f"{self.place}, {_length(self.distance_mm)} away, {tilt}{', long side vertical' if self.upright else ''}"


def _length(mm: float) -> str:
    """Return a length rounded to a few per cent; boards under a microscope are close."""
    if mm < 50.0:
        return f"{mm:.2g} mm"
    return f"{mm / 10.0:.0f} cm" if mm < 1500.0 else f"{mm / 1000.0:.1f} m"


def placement(camera: Camera, board: Board, cam_from_board: Rigid3) -> BoardInView:
    """Return a board in this pose as seen by the camera."""
    paper = outline_mm(board)
    middle = paper.mean(axis=0)
    at = cam_from_board.apply(middle)
    sight = unit(at)
    normal = cam_from_board.rotation[:, 2]
    tilt = float(np.degrees(np.arccos(np.clip(normal @ sight, -1.0, 1.0))))
    outline, valid = camera.project(cam_from_board.apply(_border(paper)))
    here, seen = camera.project(at)
    # The direction on the board towards the camera: its image is that of the nearer side.
    along = normal * (normal @ sight) - sight
    size = float(np.linalg.norm(np.ptp(paper, axis=0)))
    there, _ = camera.project(at + 0.05 * size * along)
    across, _ = camera.project(at + 0.05 * size * cam_from_board.rotation[:, int(board.rows > board.columns)])
    step, edge = there - here, across - here
    angle = float(np.degrees(np.arctan2(step[1], step[0])))
    nearer = NEARER_SIDES[round(angle / 45.0) % 8] if tilt > FACING_DEG and np.isfinite(angle) else ""
    return BoardInView(
        place=_place(here / (np.array(camera.size_px) - 1.0)) if seen else "out of view",
        distance_mm=float(np.linalg.norm(at)),
        tilt_deg=tilt,
        nearer=nearer,
        upright=bool(abs(edge[1]) > abs(edge[0])),
        outline_px=np.where(valid[:, None], outline, np.nan),
    )


def _border(paper: Pixels) -> Pixels:
    """Return the outline with more points, so that a fisheye's distortion of it is visible."""
    ahead = np.roll(paper, -1, axis=0)
    return np.concatenate(
        [a + (b - a) * np.linspace(0.0, 1.0, 6)[:-1, None] for a, b in zip(paper, ahead, strict=True)]
    )


def _place(share: Pixels) -> str:
    """Return the name of a position in the image, given as parts of its width and height."""
    low, high = MIDDLE_THIRD
    column = "left" if share[0] < low else "right" if share[0] > high else ""
    row = "top" if share[1] < low else "bottom" if share[1] > high else ""
    if row and column:
        return f"{row} {column} corner"
    return f"{row or column} edge" if row or column else "middle"
