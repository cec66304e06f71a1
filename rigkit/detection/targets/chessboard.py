"""Chessboards: the lattices of the image, on the boards' grids where that is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.checks.border import place_part
from rigkit.detection.checks.validate import known_part
from rigkit.detection.guided.guided import completed
from rigkit.detection.guided.rejoin import rejoined
from rigkit.detection.lattice.origin import quarter_turns
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.subpixel import RefinedLattice
from rigkit.detection.targets.base import Finder, Search


class ChessboardFinder(Finder):
    """All lattices that no other target has taken, whatever their size."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        sizes = tuple(dict.fromkeys(board.size for board in boards))
        lattices = [known_part(item, sizes) for item in search.lattices]
        placed = _placed(search.grey, lattices, boards, search.camera)
        found = [_detection(item, sizes) for item in placed]
        return [completed(search.grey, item, boards, search.camera) for item in found]


def _placed(
    grey: GreyImage, lattices: Sequence[RefinedLattice], boards: Sequence[Board], camera: Camera | None
) -> list[RefinedLattice]:
    """Return the grids with those that are parts of a board in their place, where that is known."""
    sizes = tuple(dict.fromkeys(board.size for board in boards))
    tried = [(item, place_part(grey, item, sizes)) for item in lattices]
    placed = [item for _, item in tried if item is not None]
    parts = [item for item, known in tried if known is None]
    if camera is None or len(parts) < 2:
        return [*placed, *parts]
    return [*placed, *(place_part(grey, item, sizes) or item for item in rejoined(parts, boards, camera))]


def _detection(refined: RefinedLattice, sizes: Sequence[tuple[int, int]]) -> BoardDetection:
    found = refined.turned(quarter_turns(refined.lattice, sizes))
    known = found.lattice.known
    grid = np.argwhere(known)[:, ::-1]
    return BoardDetection(None, *found.lattice.size, grid, found.lattice.pixels[known], found.sigma_px[known])
