"""Compute the Cramer-Rao bound of tags' corners, from pixels that show only the corner.

As `detection_bench.corner_bound`, but lines are not evenly spaced: pixels are used up to half of the distance to the
next corner, within the tag and across the gap, but not those of its blurred code.
"""

from __future__ import annotations

import numpy as np

from detection_bench.corner_bound import PARAMETERS, changing_pictures, derivatives_around
from detection_bench.scenes import BenchScene
from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.errors import InputError
from rigkit.core.patterns.aprilgrid import AprilGrid

CODE_SIGMAS = 2.5
"""Blurs (of lens and pixel together) round the code that show it."""
PIXEL_SIGMA_PX = 0.29


def tag_information(scene: BenchScene, blur_px: float) -> FloatArray:
    """Return the Fisher information (N, 9, 9) of the corners of `scene.truth()[0]`, a board of tags, at noise of
    variance 1; NaN where the neighbours in the tag are not seen. Raises InputError for other boards."""
    board, truth = scene.boards[0].board, scene.truth()[0]
    pattern = board.pattern
    if not isinstance(pattern, AprilGrid):
        raise InputError(f"tag bound: board '{board.board_id}' has no tags")
    pictures, lattice = changing_pictures(scene, blur_px), truth.lattice()
    border = pattern.border / pattern.modules().shape[1]
    edge = CODE_SIGMAS * float(np.hypot(blur_px, PIXEL_SIGMA_PX))
    out = np.full((len(truth.grid), PARAMETERS, PARAMETERS), np.nan)
    for n, (place, centre) in enumerate(zip(truth.grid, truth.pixels, strict=True)):
        sides = _sides(lattice, place)
        if not np.isfinite(sides).all():
            continue
        code = border - edge * np.linalg.norm(sides, axis=1)[::-1] / abs(float(np.linalg.det(sides)))
        # Inwards is along the sides from the tag's first corner, against them from its last.
        way = np.where(place % 2 == 0, 1.0, -1.0)[:, None]

        def within(cells: FloatArray, way: FloatArray = way, code: FloatArray = code) -> BoolArray:
            inwards = way * cells
            near = (inwards >= -0.5 * pattern.spacing) & (inwards <= 0.5)
            return np.asarray(near.all(axis=0) & ~(inwards > code[:, None]).all(axis=0))

        rows = derivatives_around(centre, sides, pictures, within, 1.0)
        if rows.shape[1] > PARAMETERS:
            out[n] = rows @ rows.T
    return out


def _sides(lattice: FloatArray, place: IntArray) -> FloatArray:
    """Return the sides (2, 2) of the tag at the corner `place` (column, row), px; NaN where they are not seen."""
    out = []
    for axis in (0, 1):
        other, step = place.copy(), 1 if place[axis] % 2 == 0 else -1
        other[axis] += step
        out.append(step * (lattice[other[1], other[0]] - lattice[place[1], place[0]]))
    return np.array(out)
