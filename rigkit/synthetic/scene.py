"""Place boards and plain panels in space, and project their corners exactly through any camera.

The world frame of a trihedral capture has its origin at the intersection of the three planes, x to the right, y down, z
away from the viewer. Plane 1 is the wall in front (normal z), plane 2 the floor (normal y), plane 3 the wall on the
right (normal x); cameras are at x, y, z < 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Pixels, Points, as_array
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit

WALLS = (0.34, 0.42, 0.28)
"""Reflectances of the walls and the floor of a room."""
BOARD_CLEARANCE_MM = 3.0
"""Gap between the paper's edge and the edge of two walls: boards that touch would hide each other's edge."""
SEAM_ROUNDING_MM = 1e-6
"""Overlaps below this are rounding: in a room of right angles boards are not moved."""


@dataclass(frozen=True, eq=False, slots=True)
class Panel:
    """A plain rectangle: a wall, a floor, a ruler across a board.

    Attributes
    ----------
    world_from_panel : x and y along the sides, origin in the middle.
    width_mm, height_mm : full extent along x and y.
    reflectance : 0 (black) to 1.
    """

    world_from_panel: Rigid3
    width_mm: float
    height_mm: float
    reflectance: float = 0.35


@dataclass(frozen=True, eq=False, slots=True)
class PlacedBoard:
    """A chessboard in the world: (columns + 1) x (rows + 1) squares, framed by a white margin.

    Attributes
    ----------
    board : the board.
    world_from_board : board frame (origin at the first inner corner, z into the board) to world.
    margin_squares : width of the white margin around the squares, in squares.
    white, black : reflectances.
    first_black : whether the square whose lower right corner is the first inner corner is black.
    """

    board: Board
    world_from_board: Rigid3
    margin_squares: float = 0.5
    white: float = 0.85
    black: float = 0.06
    first_black: bool = True

    def points(self) -> Points:
        """Return the inner corners in the world, (N, 3) mm, row by row."""
        return self.world_from_board.apply(self.board.points())

    def normal(self) -> FloatArray:
        """Return the unit normal (3,) in the world, on the printed side."""
        return np.asarray(-self.world_from_board.rotation[:, 2])

    def edge_squares(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper ends (2,) of the paper along x and y, in squares from the first inner corner."""
        low, high = self.board.pattern.outline(*self.board.size)
        return low - self.margin_squares, high + self.margin_squares

    def outline(self) -> Points:
        """Return the four corners of the paper in the world, (4, 3) mm."""
        low, high = self.edge_squares()
        xy = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
        side = np.array([self.board.square_x_mm, self.board.square_y_mm])
        return self.world_from_board.apply(np.concatenate([xy * side, np.zeros((4, 1))], axis=1))

    def see(self, camera: Camera, cam_from_world: Rigid3) -> tuple[Pixels, BoolArray]:
        """Return the exact pixels (N, 2) of all corners, and a mask (N,) of those in the image, seen from the front."""
        points = cam_from_world.apply(self.points())
        pixels, valid = camera.project(points)
        width, height = camera.size_px
        with np.errstate(invalid="ignore"):
            inside = ((pixels > -0.5) & (pixels < [width - 0.5, height - 0.5])).all(axis=-1)
        facing = float((cam_from_world.rotation @ self.normal()) @ points[0]) < 0.0
        return pixels, valid & inside & facing


def exact_detection(placed: PlacedBoard, camera: Camera, cam_from_world: Rigid3) -> BoardDetection:
    """Return the exact detection of `placed`, without corners outside the image; its sigmas are 0.01 px."""
    pixels, valid = placed.see(camera, cam_from_world)
    board, sigma_px = placed.board, np.full(int(valid.sum()), 0.01)
    return BoardDetection(board.board_id, *board.size, board.grid()[valid], pixels[valid], sigma_px)


def wall_axes(angles_deg: tuple[float, float, float]) -> tuple[Mat3, Mat3, Mat3]:
    """Return world_from_board rotations of three planes at the angles (1-2, 1-3, 2-3), in degrees.

    Raises InputError if no three planes have those angles.
    """
    a12, a13, a23 = np.radians(as_array(angles_deg, (3,), "angles_deg"))
    n1 = np.array([0.0, 0.0, 1.0])
    n2 = np.array([0.0, np.sin(a12), np.cos(a12)])
    y3 = (np.cos(a23) - np.cos(a12) * np.cos(a13)) / np.sin(a12)
    rest = 1.0 - y3**2 - np.cos(a13) ** 2
    if not rest > 1e-6:
        raise InputError(f"trihedral: no three planes stand at angles {angles_deg} degrees to each other")
    n3 = np.array([np.sqrt(rest), y3, np.cos(a13)])
    along_12, along_13 = unit(np.cross(n2, n1)), unit(np.cross(n1, n3))
    return (
        np.stack([along_12, np.cross(n1, along_12), n1], axis=1),
        np.stack([along_12, np.cross(n2, along_12), n2], axis=1),
        np.stack([np.cross(along_13, n3), along_13, n3], axis=1),
    )


def trihedral(
    boards: Sequence[Board],
    *,
    angles_deg: tuple[float, float, float] = (90.0, 90.0, 90.0),
    margin_squares: float = 0.5,
    clearance_mm: float = BOARD_CLEARANCE_MM,
) -> tuple[PlacedBoard, PlacedBoard, PlacedBoard]:
    """Return three boards pushed into the corner of a room: front wall, floor, right wall.

    Each board is parallel to an edge of the room. If edges meet at less than a right angle, it is moved along its edge
    until it does not intersect the third plane.

    Parameters
    ----------
    boards : three boards of any sizes.
    angles_deg : angles between planes 1-2, 1-3 and 2-3.
    clearance_mm : from the paper's edges to the edges of the room.
    """
    if len(boards) != 3:
        raise InputError(f"trihedral: three boards expected, got {len(boards)}")
    # The paper's corner in the corner of the room, in board axes (+1: the far end, -1: the near end).
    corner_side = ((1, 1), (1, -1), (-1, 1))
    walls = wall_axes(angles_deg)
    # The board axis parallel to the edge of the room, and the plane at the end of that edge.
    along_seam = ((0, 2), (0, 2), (1, 1))
    out = []
    for board, axes, side, (axis, end) in zip(boards, walls, corner_side, along_seam, strict=True):
        low, high = board.pattern.outline(*board.size)
        far, near = (side * board.squares_mm + clearance_mm for side in (high + margin_squares, margin_squares - low))
        origin = np.where(np.array(side) > 0, -far, near)
        placed = PlacedBoard(board, Rigid3(axes, axes[:, :2] @ origin), margin_squares)
        facing = walls[end][:, 2]
        beyond = float((placed.outline() @ facing).max()) + clearance_mm
        if beyond > SEAM_ROUNDING_MM:
            step = beyond / float(facing @ axes[:, axis]) * axes[:, axis]
            moved = Rigid3(axes, placed.world_from_board.translation_mm - step)
            placed = replace(placed, world_from_board=moved)
        out.append(placed)
    return (out[0], out[1], out[2])


def room_walls(
    size_mm: float = 2500.0, *, angles_deg: tuple[float, float, float] = (90.0, 90.0, 90.0)
) -> tuple[Panel, ...]:
    """Return the two walls and the floor behind a trihedral capture, a millimetre behind the boards."""
    half = size_mm / 2.0
    sides = ((-half, -half), (-half, half), (half, -half))
    return tuple(
        Panel(Rigid3(axes, axes @ np.array([*side, 1.0])), size_mm, size_mm, rho)
        for axes, side, rho in zip(wall_axes(angles_deg), sides, WALLS, strict=True)
    )


def place_board(
    board: Board, camera: Camera, target_px: FloatArray, square_px: float, max_tilt_deg: float, rng: np.random.Generator
) -> PlacedBoard | None:
    """Return the board with its centre at `target_px`, randomly tilted, or None outside of the field of view."""
    ray, valid = camera.unproject(target_px)
    if not valid:
        return None
    # Pixels per radian at the target, which gives the distance for the size of a square.
    scale = 1.0 / np.linalg.svd(camera.ray_jacobian(target_px), compute_uv=False)[0]
    depth = board.square_x_mm * scale / square_px
    facing = _rotation_to(ray)
    axis = rng.uniform(0.0, 2.0 * np.pi)
    tilt = np.radians(max_tilt_deg) * np.sqrt(rng.uniform())
    turn = exp_so3(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
    roll = exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    rotation = facing @ turn @ roll
    middle = np.array([(board.columns - 1) * board.square_x_mm, (board.rows - 1) * board.square_y_mm, 0.0]) / 2.0
    return PlacedBoard(board, Rigid3(rotation, ray * depth - rotation @ middle))


def _rotation_to(ray: FloatArray) -> FloatArray:
    """Return a rotation whose z axis is `ray`."""
    helper = np.array([0.0, 1.0, 0.0]) if abs(ray[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = unit(np.cross(helper, ray))
    return np.stack([x, np.cross(ray, x), ray], axis=1)


def sees_paper(
    placed: PlacedBoard, camera: Camera, low: FloatArray | tuple[float, float], high: FloatArray | tuple[int, int]
) -> bool:
    """Return whether the whole paper is visible inside the image rectangle from `low` to `high`."""
    pixels, valid = camera.project(placed.outline())
    corners, seen = placed.see(camera, Rigid3.identity())
    if not (valid.all() and seen.all()):
        return False
    both = np.concatenate([pixels, corners])
    return bool((both > np.asarray(low) + 2.0).all() and (both < np.asarray(high) - 3.0).all())
