"""Poses in which a person can hold a board: completely in view, tilted, and close enough that its squares are found.
And such a pose as an instruction: "top edge, 40 cm away, tilted 35 degrees, left side nearer"."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera, image_center
from rigkit.core.arrays import BoolArray, FloatArray, Pixels, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.planning.information import BoardPoses

CANDIDATES_DRAWN, CANDIDATES_KEPT = 2400, 900
"""Candidate poses generated, and the most kept: both cover position, tilt and size evenly."""
TILT_DEG = (15.0, 60.0)
"""Flat views do not determine the focal length; with more tilt, corners are foreshortened too much for precision."""
SIZE_SHARE = (0.35, 1.6)
"""Diagonal of a board in the image, as a part of the image's height."""
UPRIGHT_SHARE = 0.3
"""Part of the poses with the board turned by 90 degrees."""
MIN_SQUARE_PX = 8.0
"""Smaller squares are not detected reliably."""
BORDER_SHARE = 0.01
"""Margin between paper and image border, as a part of the image's width: hands are not that steady."""
MOVES = 5
"""Iterations that push a board that extends beyond the image back into it."""
INWARD = 0.12
"""Part of the distance to the image centre by which a board that leaves the field of view is moved in each."""
MAX_SLANT_DEG = 76.0
"""Largest angle between a line of sight and the board's normal, at any of its corners."""
MIDDLE_THIRD = (0.38, 0.62)
FACING_DEG = 8.0
NEARER_SIDES = ("right side", "lower right corner", "lower side", "lower left corner", "left side", "upper left corner",
         "upper side", "upper right corner")  # fmt: skip
"""Every 45 degrees in the image, clockwise from the right."""


def outline_mm(board: Board) -> Points:
    """Return the outline of a board's squares, one square beyond its outer corners: its four corners, each followed by
    the midpoint to the next, (8, 3), clockwise as seen."""
    points = board.points()[:, :2]
    square = np.array([board.square_x_mm, board.square_y_mm])
    (left, top), (right, bottom) = points.min(axis=0) - square, points.max(axis=0) + square
    corners = np.array([[left, top, 0.0], [right, top, 0.0], [right, bottom, 0.0], [left, bottom, 0.0]])
    between = 0.5 * (corners + np.roll(corners, -1, axis=0))
    return np.stack([corners, between], axis=1).reshape(8, 3)


def board_poses_in_view(camera: Camera, board: Board, reach: Reach) -> BoardPoses:
    """Return poses of `board` that a person can hold in front of `camera`, evenly spread and deterministic.

    Raises DegenerateError where the board never fits into the image.
    """
    u, v, size, tilt, azimuth, upright = _low_discrepancy(CANDIDATES_DRAWN, 6).T
    width, height = camera.size_px
    facing = _tilted(np.radians(TILT_DEG[0] + tilt * (TILT_DEG[1] - TILT_DEG[0])), 2.0 * np.pi * azimuth)
    facing = facing @ exp_so3(np.where(upright < UPRIGHT_SHARE, 0.5 * np.pi, 0.0)[:, None] * np.array([0.0, 0.0, 1.0]))
    square_px = (
        (SIZE_SHARE[0] + size * (SIZE_SHARE[1] - SIZE_SHARE[0])) * height / np.hypot(*(np.array(board.size) + 1))
    )
    paper = outline_mm(board)
    middle = paper.mean(axis=0)
    spot = np.stack([u * width, v * height], axis=-1) - 0.5
    moving = np.arange(len(spot))
    for _ in range(MOVES):
        held, seen = _placed(camera, board, spot[moving], facing[moving], square_px[moving], middle)
        points = held.in_cam(paper)
        pixels, valid = camera.project(points)
        push = _shift_inside(camera, pixels, valid & seen[:, None] & _in_field(points, reach.field_deg))
        spot[moving] += push
        moving = moving[push.any(axis=1)]
    held, good = _placed(camera, board, spot, facing, square_px, middle)
    good &= board_in_view(camera, board, held, reach)
    distance = np.linalg.norm(held.rotation @ middle + held.translation_mm, axis=-1)
    good &= (distance >= reach.nearest_mm) & (distance <= reach.farthest_mm)
    if not good.any():
        raise DegenerateError(
            f"plan: board '{board.board_id}' ({board.columns}x{board.rows} corners) is nowhere completely in view at "
            "the allowed distances; take a smaller board, or allow other distances"
        )
    return held.chosen(np.flatnonzero(good)[:CANDIDATES_KEPT])


def board_in_view(camera: Camera, board: Board, held: BoardPoses, reach: Reach) -> BoolArray:
    """Say for each of C poses whether the camera sees the whole board, large enough and not too slanted."""
    return _inside(camera, held.in_cam(outline_mm(board)), reach.field_deg) & _squares_visible(camera, board, held)


def _low_discrepancy(count: int, dimensions: int) -> FloatArray:
    """Return `count` points that fill the unit cube evenly: multiples of the powers of the generalised golden ratio.

    Reference: M. Roberts, "The unreasonable effectiveness of quasirandom sequences" (2018).
    """
    ratio = 2.0
    for _ in range(32):
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    powers = ratio ** -np.arange(1.0, dimensions + 1.0)
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] * powers) % 1.0)


def _tilted(tilt_rad: FloatArray, azimuth_rad: FloatArray) -> FloatArray:
    """Return rotations (C, 3, 3) that tilt a facing board so that its side at `azimuth_rad` comes towards the
    camera."""
    # A rotation a moves d by a x d: with a = (-d_y, d_x, 0) that is along -z, towards the camera.
    axis = np.stack([-np.sin(azimuth_rad), np.cos(azimuth_rad), np.zeros_like(azimuth_rad)], axis=-1)
    return np.asarray(exp_so3(tilt_rad[:, None] * axis))


def _placed(
    camera: Camera, board: Board, spot: Pixels, facing: FloatArray, square_px: FloatArray, middle: FloatArray
) -> tuple[BoardPoses, BoolArray]:
    """Return the poses with the board's centre at `spot` (C, 2) in the image and a square `square_px` wide if seen
    frontally, and whether `spot` is in the field of view."""
    rays, seen = camera.unproject(spot)
    rays = np.where(seen[:, None], rays, [0.0, 0.0, 1.0])
    # Radians per pixel, the larger of the two directions: no square is wider than `square_px`.
    scale = np.linalg.norm(np.where(seen[:, None, None], camera.ray_jacobian(spot), 0.0), axis=1).max(axis=-1)
    distance = min(board.square_x_mm, board.square_y_mm) / np.where(seen, scale * square_px, 1.0)
    # Upright in the image, also at large angles of a fisheye.
    down = np.where(np.abs(rays[:, 1:2]) < 0.95, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    x = unit(np.cross(down, rays))
    towards = np.stack([x, np.cross(rays, x), rays], axis=-1)
    rotation = towards @ facing
    translation = rays * distance[:, None] - rotation @ middle
    held = BoardPoses(board.points(), rotation, translation, np.ones((len(rays), board.corner_count), bool))
    return held, np.asarray(seen & np.isfinite(distance))


def _shift_inside(camera: Camera, pixels: Pixels, valid: BoolArray) -> FloatArray:
    """Return the shifts (C, 2) px that move boards with outlines at `pixels` (C, 8, 2) into the image; boards partly
    outside the field of view move towards the image centre."""
    width, height = camera.size_px
    border = BORDER_SHARE * width
    whole, any_seen = np.all(valid, axis=1), np.any(valid, axis=1)
    safe = np.where(whole[:, None, None], pixels, image_center(camera.size_px))
    low, high = safe.min(axis=1), safe.max(axis=1)
    push = np.maximum(border - low, 0.0) + np.minimum(np.array([width, height]) - 1.0 - border - high, 0.0)
    shown = np.where(valid[..., None], pixels, 0.0).sum(axis=1) / np.maximum(valid.sum(axis=1), 1)[:, None]
    inward = np.where(any_seen[:, None], INWARD * (image_center(camera.size_px) - shown), 0.0)
    return np.where(whole[:, None], push, inward)


def _inside(camera: Camera, paper: Points, field_deg: float | None) -> BoolArray:
    """Say for each outline (C, 8, 3), in the camera frame, whether all of it is in the image."""
    pixels, valid = camera.project(paper)
    inside = valid & camera.on_image(pixels) & _in_field(paper, field_deg)
    return np.asarray(np.all(inside, axis=1))


def _in_field(points: Points, field_deg: float | None) -> BoolArray:
    """Say which points (..., 3) are within a field of view."""
    limit = -2.0 if field_deg is None else np.cos(np.radians(0.5 * field_deg))
    return np.asarray(points[..., 2] >= limit * np.linalg.norm(points, axis=-1))


def _squares_visible(camera: Camera, board: Board, held: BoardPoses) -> BoolArray:
    """Say for each board whether all squares are large enough, and no line of sight too slanted."""
    columns, rows = board.size
    lattice = board.points().reshape(rows, columns, 3)[[0, 0, -1, -1], [0, -1, 0, -1]]
    step = np.array([board.square_x_mm, board.square_y_mm, 0.0]) * np.eye(3)[:2]
    points = held.in_cam(np.concatenate([lattice, lattice + step[0], lattice + step[1]]))
    pixels, valid = camera.project(points)
    sides = np.concatenate([pixels[:, 4:8] - pixels[:, :4], pixels[:, 8:] - pixels[:, :4]], axis=1)
    with np.errstate(invalid="ignore"):
        large = (np.linalg.norm(sides, axis=-1) >= MIN_SQUARE_PX).all(axis=1)
    slant = np.einsum("cnx,cx->cn", unit(points[:, :4]), held.rotation[..., 2])
    return np.asarray(large & valid.all(axis=1) & (slant >= np.cos(np.radians(MAX_SLANT_DEG))).all(axis=1))


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
