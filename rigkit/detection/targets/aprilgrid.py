"""AprilGrids: lattices of saddles whose lines are not evenly spaced, on the board's grid by the tags between them.

Where tags stand alone, there are no saddles: the tags are sought.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.lattice.lattice import build_lattices
from rigkit.detection.lattice.links import LENGTH_RATIO, find_links
from rigkit.detection.saddles.response import pyramid
from rigkit.detection.saddles.saddle import find_corners
from rigkit.detection.tags.corners import tag_corners
from rigkit.detection.tags.placing import TagBoard, placed_lattices
from rigkit.detection.tags.quads import placed_tags
from rigkit.detection.targets.base import Finder, Search


class AprilGridFinder(Finder):
    """Corners of tags are linked as those of chessboards are, only that opposite neighbours may lie further apart."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        tags = [TagBoard.of(board) for board in boards]
        found = []
        for board, pixels in self._placed(search, tags):
            seen = tag_corners(search.grey, board, pixels, search.camera) if np.isfinite(pixels).any() else None
            if seen is not None and len(seen.grid) >= search.min_corners:
                found.append(seen)
        return found

    def _placed(self, search: Search, tags: Sequence[TagBoard]) -> Iterator[tuple[TagBoard, FloatArray]]:
        """Yield the boards and their rough corners (R, C, 2), NaN where none is seen."""
        joined = [item for item in tags if item.pattern.corner_squares]
        yield from ((item, placed_tags(search.grey, item)) for item in tags if not item.pattern.corner_squares)
        if not joined:
            return
        ratio = LENGTH_RATIO * max(max(t.pattern.spacing, 1.0 / t.pattern.spacing) for t in joined)
        levels = pyramid(search.grey)
        corners, _ = find_corners(levels)
        lattices = list(build_lattices(corners, find_links(corners, levels[0], ratio)))
        for item in joined:
            pixels, used = placed_lattices(search.grey, lattices, item)
            lattices = [lattice for n, lattice in enumerate(lattices) if n not in used]
            yield item, pixels
