"""How well the tags or markers of a board in an image agree with their print."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.codes import Codes
from rigkit.detection.tags.in_squares import as_printed, marker_codes, marker_outlines
from rigkit.kernels.surface import read_modules


def likeness_to_print(image: GreyImage, lattice: FloatArray, board: Board) -> FloatArray:
    """Return the correlation (N,) of each tag of an AprilGrid, or marker of a ChArUco board, that is in an image with
    its code as printed; lattice (R, C, 2): the corners, NaN where unknown."""
    pattern = board.pattern
    if isinstance(pattern, AprilGrid):
        corners = lattice.reshape(board.rows // 2, 2, board.columns // 2, 2, 2)
        quads = corners[:, [0, 0, 1, 1], :, [0, 1, 1, 0]].transpose(1, 2, 0, 3).reshape(-1, 4, 2)
        codes = Codes.of(pattern, pattern.numbers(*board.size).ravel())
    else:
        assert isinstance(pattern, Charuco)
        quads, codes = marker_outlines(image, lattice, board), marker_codes(board)
    seen = np.flatnonzero(np.isfinite(quads).all(axis=(1, 2)))
    if not len(seen):
        return np.zeros(0)
    bright, _ = read_modules(as_printed(image, pattern), quads[seen], codes.modules)
    # The codes of each mark are in four orientations, the printed one first.
    return np.asarray((bright * codes.patterns[4 * seen]).sum(axis=1))
