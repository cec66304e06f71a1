"""Joining of the parts of a partly covered board with a calibrated camera.

The pose of one part, from its squares and the camera, determines the positions of the other part's corners on its
plane. They are parts of one board if these are on its grid and the colours continue.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.detection.guided.board_guide import MIN_GUIDE_CORNERS
from rigkit.detection.lattice.lattice import Lattice, margins
from rigkit.detection.saddles.saddle import SAME_CORNER_PX
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.geometry.board_pose import board_poses
from rigkit.geometry.rigid3 import Rigid3

OFF_GRID = 0.15
"""Largest median distance from the grid of the other part, in squares: poses of small parts have errors, while other
boards are off by arbitrary fractions of a square."""

OFF_PLANE, OFF_PLANE_PX = 0.03, 0.5
"""Largest median residual of the smaller part under the common pose, in squares or (the larger) in px."""


def rejoined(parts: Sequence[RefinedLattice], boards: Sequence[Board], camera: Camera) -> list[RefinedLattice]:
    """Return `parts` with those of one board joined.

    Parameters
    ----------
    parts : lattices with unknown positions on their boards.
    boards : the possible boards; those whose squares have unequal sides are ignored.
    camera : of the image.
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
            # The larger part has a better pose: try the others again.
            del rest[k]
            one, k = both, 0
        out.append(one)
    return out


def _both(one: RefinedLattice, two: RefinedLattice, boards: Sequence[Board], camera: Camera) -> RefinedLattice | None:
    """Return the larger part `one` joined with `two`; None if they are not parts of one board."""
    if one.lattice.count < MIN_GUIDE_CORNERS:
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
    """Return the possible poses of the grid with squares of `side_mm`, the better first."""
    row, column = np.nonzero(lattice.known)
    pixels = lattice.pixels[row, column]
    rays, seen = camera.unproject(pixels)
    if seen.sum() < MIN_GUIDE_CORNERS:
        return []
    points = side_mm * np.stack([column, row, np.zeros(len(row))], axis=-1, dtype=np.float64)
    bases = np.asarray(np.linalg.pinv(camera.ray_jacobian(pixels[seen])), dtype=np.float64)
    try:
        return [pose.cam_from_board for pose in board_poses(rays[seen], points[seen], bases=bases)]
    except DegenerateError:
        return []


def _on_plane(lattice: Lattice, cam_from_grid: Rigid3, camera: Camera) -> FloatArray:
    """Return the intersections (R, C, 2), mm, of the corners' rays with the plane of the grid; NaN without one."""
    rays, seen = camera.unproject(np.nan_to_num(lattice.pixels))
    grid_from_cam = cam_from_grid.inverse()
    direction, eye = rays @ grid_from_cam.rotation.T, grid_from_cam.translation_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -eye[2] / direction[..., 2:]
        met = eye[:2] + along * direction[..., :2]
    return np.where((lattice.known & seen)[..., None] & (along > 0.0), met, np.nan)


def _shift(lattice: Lattice, on_grid: FloatArray) -> IntArray | None:
    """Return the shift (columns, rows) of the part on the grid; None if its corners are not on the grid."""
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
    """Return `one` joined with `two` shifted by `shift`; None if the result is larger than all `sizes` (columns, rows),
    the colours do not continue, or corners with the same index differ."""
    around = margins(one.lattice.size, two.lattice.size, shift)
    # Check the size before allocating: almost parallel rays give arbitrary shifts.
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
    if (separation > SAME_CORNER_PX).any():
        return None
    return first.filled(second)


def _flat(both: RefinedLattice, two: RefinedLattice, shift: IntArray, side_mm: float, camera: Camera) -> bool:
    """Return whether a common pose fits the smaller part too."""
    row, column = np.nonzero(two.lattice.known)
    place = np.stack([column, row], axis=-1) + np.maximum(shift, 0)
    pixels = two.lattice.pixels[row, column]
    points = np.column_stack([place, np.zeros(len(place))]) * side_mm
    for pose in _poses(both.lattice, side_mm, camera):
        projected, _ = camera.project(pose.apply(points))
        off = float(np.median(np.linalg.norm(projected - pixels, axis=1)))
        side = float(np.nanmedian(np.linalg.norm(np.diff(two.lattice.pixels, axis=1), axis=-1)))
        if off < max(OFF_PLANE_PX, OFF_PLANE * side):
            return True
    return False
