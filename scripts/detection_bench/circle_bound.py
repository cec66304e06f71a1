"""Compute the Cramer-Rao bound of the centre of every circle of a rendered scene.

As `detection_bench.corner_bound`, with ten unknowns for each circle: its position (2), size and slant (3), the blur
(1), and brightness, contrast and the light's gradient (4). Assumed known: the nonlinearity of the map from the plane to
the image, which displaces the centre from that of the ellipse, constant blur and noise over the cell, the noise level.
"""

from __future__ import annotations

import numpy as np

from detection_bench.corner_bound import changing_pictures, pixels_around
from detection_bench.scenes import BenchScene
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.errors import InputError
from rigkit.core.patterns.circles import Circles
from rigkit.synthetic.scene import PlacedBoard

CIRCLE_PARAMETERS = 10
CIRCLE_CHANGES = (np.eye(2), np.diag([1.0, -1.0]), np.array([[0.0, 1.0], [1.0, 0.0]]))
"""Changes of a circle: of its size, and of its slant along and aslant of x."""


def circle_information(scene: BenchScene, blur_px: float) -> FloatArray:
    """Return the Fisher information (N, 10, 10) of the circles of the one board of `scene`, at noise of variance 1.

    In the order of `scene.truth()`; in grey levels squared. The first two parameters are u and v, px. Covariances of it
    makes `corner_bound.position_bound`. NaN where too few pixels of a cell lie in the image.

    Raises InputError where the scene's board is not one of circles.
    """
    (placed,) = scene.boards
    pattern = placed.board.pattern
    if not isinstance(pattern, Circles):
        raise InputError(f"circle bound: board '{placed.board.board_id}' has no circles")
    pictures = changing_pictures(scene, blur_px)
    truth = scene.truth()[0]
    half_mm = 0.5 * pattern.nearest_mm(placed.board.squares_mm)
    sides = _sides(scene, placed, truth.grid, half_mm)
    out = np.full((len(truth.grid), CIRCLE_PARAMETERS, CIRCLE_PARAMETERS), np.nan)
    for n, (centre, matrix) in enumerate(zip(truth.pixels, sides, strict=True)):
        rows = _derivatives(centre, matrix, pictures)
        if rows.shape[1] > CIRCLE_PARAMETERS:
            out[n] = rows @ rows.T
    return out


def _sides(scene: BenchScene, placed: PlacedBoard, grid: IntArray, half_mm: float) -> FloatArray:
    """Return (N, 2, 2) how far the image moves over half the way to a neighbour along x and y, px, in columns."""
    points = placed.board.points(grid)
    ends = []
    for axis in (0, 1):
        step = half_mm * np.eye(3)[axis]
        after, before = (scene.camera.project(placed.world_from_board.apply(points + s * step))[0] for s in (1, -1))
        ends.append((after - before) / 2.0)
    return np.stack(ends, axis=-1)


def _derivatives(centre: FloatArray, matrix: FloatArray, pictures: FloatArray) -> FloatArray:
    """Return the derivatives (10, P) of the pixels of the round cell about `centre`, |w| < 1 in place matrix @ w."""
    reach = np.sqrt((matrix**2).sum(axis=1))
    window = pixels_around(centre, reach, pictures)
    if window is None:
        return np.zeros((CIRCLE_PARAMETERS, 0))
    offset, cut = window
    place = np.linalg.solve(matrix, offset)
    inside = np.hypot(*place) <= 1.0
    by_u, by_v, by_blur, light = cut[:, inside]
    shapes = [
        by_u * moved[0] + by_v * moved[1] for moved in (matrix @ shape @ place[:, inside] for shape in CIRCLE_CHANGES)
    ]
    du, dv = offset[:, inside] / float(np.linalg.norm(reach))
    return np.stack([by_u, by_v, *shapes, by_blur, np.ones_like(light), light, light * du, light * dv])
