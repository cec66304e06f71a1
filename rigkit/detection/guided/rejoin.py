"""Parts of a board that something lies across, put together with the help of a calibrated camera.

Each part alone has its squares, not its place in the board. But the pose of one says, through the camera, where on its
plane the corners of the other lie: they are parts of one board where that is on its grid, and its colours go on there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.detection.lattice.lattice import Lattice, margins
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.geometry.board_pose import board_poses
from rigkit.geometry.rigid3 import Rigid3

MIN_REJOINED_CORNERS = 12
"""Corners from which on a part has a pose that says where the rest of its board is."""

OFF_GRID = 0.15
"""Median distance from the grid of the other part, in squares: poses of small parts err, but a plane through another
wall, or a board beside it, is off by any part of a square."""

OFF_PLANE, OFF_PLANE_PX = 0.03, 0.5
"""Median distance of the smaller part from where the pose of both together has it, in squares or (the larger) in px."""

SAME_REJOINED_PX = 2.0
"""What both parts have is one corner if it lies this near, and else they are no parts of one board."""


def rejoined(parts: Sequence[RefinedLattice], boards: Sequence[Board], camera: Camera) -> list[RefinedLattice]:
    """Return `parts` with those that are of one board as one.

    Parameters
    ----------
    parts : grids that have no place in a board yet.
    boards : the boards that they may be of; those whose squares are longer one way are not considered.
    camera : what took the image.
    """
    even = [board for board in boards if board.square_x_mm == board.square_y_mm]
    rest = sorted(parts, key=lambda item: -item.lattice.count)
    out = []
    while rest:
        one, *rest = rest
        k = 0
        while k < len(rest):
            both = _both(one, rest[k], even, camera)
            if both is None:
                k += 1
                continue
            # With more of the board its pose says more: the others are asked again.
            del rest[k]
            one, k = both, 0
        out.append(one)
    return out


def _both(one: RefinedLattice, two: RefinedLattice, boards: Sequence[Board], camera: Camera) -> RefinedLattice | None:
    """Return the larger part `one` with `two` in its place; None where they are not of one board."""
    if one.lattice.count < MIN_REJOINED_CORNERS:
        return None
    for side_mm in {board.square_x_mm for board in boards}:
        sizes = {size for b in boards if b.square_x_mm == side_mm for size in (b.size, b.size[::-1])}
        for cam_from_grid in _poses(one.lattice, side_mm, camera):
            on_grid = _on_plane(two.lattice, cam_from_grid, camera) / side_mm
            for turns in range(4):
                turned = two.turned(turns)
                shift = _shift(turned.lattice, np.rot90(on_grid, -turns))
                both = None if shift is None else _united(one, turned, shift, sizes)
                if both is not None and shift is not None and _flat(both, turned, shift, side_mm, camera):
                    return both
    return None


def _poses(lattice: Lattice, side_mm: float, camera: Camera) -> list[Rigid3]:
    """Return the poses that the grid may have, squares of `side_mm` assumed: the better first."""
    row, column = np.nonzero(lattice.known)
    pixels = lattice.pixels[row, column]
    rays, seen = camera.unproject(pixels)
    if seen.sum() < MIN_REJOINED_CORNERS:
        return []
    points = side_mm * np.stack([column, row, np.zeros(len(row))], axis=-1, dtype=np.float64)
    bases = np.asarray(np.linalg.pinv(camera.ray_jacobian(pixels[seen])), dtype=np.float64)
    try:
        return [pose.cam_from_board for pose in board_poses(rays[seen], points[seen], bases=bases)]
    except DegenerateError:
        return []


def _on_plane(lattice: Lattice, cam_from_grid: Rigid3, camera: Camera) -> FloatArray:
    """Return where the rays of the corners meet the plane of the grid, (R, C, 2) mm; NaN where they do not."""
    rays, seen = camera.unproject(np.nan_to_num(lattice.pixels))
    grid_from_cam = cam_from_grid.inverse()
    direction, eye = rays @ grid_from_cam.rotation.T, grid_from_cam.translation_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -eye[2] / direction[..., 2:]
        met = eye[:2] + along * direction[..., :2]
    return np.where((lattice.known & seen)[..., None] & (along > 0.0), met, np.nan)


def _shift(lattice: Lattice, on_grid: FloatArray) -> IntArray | None:
    """Return by how many (columns, rows) the part lies off its place in the grid; None where it is on no grid."""
    rows, columns = lattice.known.shape
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    off = (on_grid - cells)[np.isfinite(on_grid[..., 0])]
    if 2 * len(off) < lattice.count:
        return None
    shift = np.round(np.median(off, axis=0))
    separation = float(np.median(np.linalg.norm(off - shift, axis=1)))
    return shift.astype(np.int64) if separation < OFF_GRID else None


def _united(
    one: RefinedLattice, two: RefinedLattice, shift: IntArray, sizes: set[tuple[int, int]]
) -> RefinedLattice | None:
    """Return `two`, moved by `shift`, put into `one`; None if that is larger than any of the `sizes` (columns, rows),
    its colours do not go on, or two corners want one place."""
    around = margins(one.lattice.size, two.lattice.size, shift)
    # Before anything of that size is made: two planes that nearly miss each other put it anywhere.
    (above, below), (left, right) = around[0]
    columns, rows = one.lattice.size[0] + left + right, one.lattice.size[1] + above + below
    if not any(columns <= c and rows <= r for c, r in sizes):
        return None
    first, second = (item.padded(*m) for item, m in zip((one, two), around, strict=True))
    if first.lattice.rising != second.lattice.rising:
        return None
    known = first.lattice.known
    twice = known & second.lattice.known
    separation = np.linalg.norm(first.lattice.pixels - second.lattice.pixels, axis=-1)[twice]
    if (separation > SAME_REJOINED_PX).any():
        return None
    return first.filled(second)


def _flat(both: RefinedLattice, two: RefinedLattice, shift: IntArray, side_mm: float, camera: Camera) -> bool:
    """Return whether one pose explains both parts, the smaller one too."""
    row, column = np.nonzero(two.lattice.known)
    place = np.stack([column, row], axis=-1) + np.maximum(shift, 0)
    pixels = two.lattice.pixels[row, column]
    points = np.column_stack([place, np.zeros(len(place))]) * side_mm
    for pose in _poses(both.lattice, side_mm, camera):
        projected, _ = camera.project(pose.apply(points))
        off = float(np.median(np.linalg.norm(projected - pixels, axis=1)))
        beside = np.diff(two.lattice.pixels, axis=1)
        side = float(np.nanmedian(np.linalg.norm(beside, axis=-1)))
        if off < max(OFF_PLANE_PX, OFF_PLANE * side):
            return True
    return False
