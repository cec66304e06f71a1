"""AprilGrids: lattices of saddles whose lines are not evenly spaced, on the board's grid by the tags between them."""

from __future__ import annotations

from collections.abc import Sequence

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.detection.lattice.lattice import build_lattices
from rigkit.detection.lattice.links import LENGTH_RATIO, find_links
from rigkit.detection.saddles.response import pyramid
from rigkit.detection.saddles.saddle import find_corners
from rigkit.detection.tags.corners import tag_corners
from rigkit.detection.tags.placing import TagBoard, placed_lattices
from rigkit.detection.targets.base import Finder, Search

__all__ = ["AprilGridFinder"]


class AprilGridFinder(Finder):
    """Corners of tags are linked as those of chessboards are, only that opposite neighbours may lie further apart."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        tags = [TagBoard.of(board) for board in boards]
        for item in tags:
            if not item.pattern.corner_squares:
                raise InputError(
                    f"board '{item.board.board_id}': tags without small squares between them are printed, but not "
                    "found in images; print a board with corner_squares = true"
                )
        ratio = LENGTH_RATIO * max(max(t.pattern.spacing, 1.0 / t.pattern.spacing) for t in tags)
        levels = pyramid(search.grey)
        corners, _ = find_corners(levels)
        lattices = list(build_lattices(corners, find_links(corners, levels[0], ratio)))
        found = []
        for board in tags:
            pixels, used = placed_lattices(search.grey, lattices, board)
            lattices = [lattice for n, lattice in enumerate(lattices) if n not in used]
            seen = tag_corners(search.grey, board, pixels, search.camera) if used else None
            if seen is not None and len(seen.grid) >= search.min_corners:
                found.append(seen)
        return found
