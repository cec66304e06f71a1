"""The interface of the finders of targets, and the data that they share for one image."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import known_median
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.checks.validate import BY_CHANCE, has_edge_offset, is_large_enough
from rigkit.detection.lattice.lattice import MIN_ROWS
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.lattices import (
    MIN_BOARD_CORNERS,
    BoardCriteria,
    corner_count,
    find_lattices,
    fit_and_confirm,
)
from rigkit.detection.saddles.local_contrast import equalised, stretched
from rigkit.detection.saddles.response import BASE_PIXELS, GreyImage, each_level
from rigkit.detection.searched_image import SearchedImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.tags.in_squares import has_markers_of

SMALL_SQUARE_PX = 24.0
"""Largest squares, px, whose markers leave white lines narrower than the ring of the finest level (radius 2.6 px)."""

MIN_MARKED = 4
"""Smallest number of corners of a ChArUco board, which determine its pose."""


class Search:
    """An image with the results that several finders use.

    Attributes
    ----------
    grey : grey levels 0..255.
    boards : all boards that may be in the image.
    min_corners : smallest number of points of a reported board, except whole ones of `boards`.
    camera : the calibrated camera, if known.
    stored : grey levels before bad pixels were replaced, which modules of small markers resemble.
    quick : an accuracy of about a tenth of a pixel is enough.
    """

    def __init__(
        self,
        grey: GreyImage,
        boards: Sequence[Board],
        min_corners: int,
        camera: Camera | None,
        stored: GreyImage | None = None,
        *,
        quick: bool = False,
    ) -> None:
        self.grey = grey
        self.stored = grey if stored is None else stored
        self.boards = tuple(boards)
        self.min_corners = min_corners
        self.camera = camera
        self.quick = quick
        self._lattices: list[RefinedLattice] | None = None

    @property
    def chessboard_sizes(self) -> tuple[tuple[int, int], ...]:
        """(columns, rows) of the chessboards among the boards."""
        plain = (board.size for board in self.boards if board.pattern.type == Chessboard.type)
        return tuple(dict.fromkeys(plain))

    @property
    def has_lattices(self) -> bool:
        """Whether the lattices were searched for."""
        return self._lattices is not None

    @property
    def lattices(self) -> list[RefinedLattice]:
        """The lattices of chessboard corners that no finder has used; searched for at the first access."""
        if self._lattices is None:
            self._lattices = self._found_lattices()
        return self._lattices

    def leave(self, lattices: Sequence[RefinedLattice]) -> None:
        """Keep for other finders only those of these lattices that may be chessboards."""
        large = [item for item in lattices if is_large_enough(item.lattice, MIN_BOARD_CORNERS)]
        finest = next(each_level(self.grey)) if large else None
        self._lattices = [item for item in large if finest and not has_edge_offset(item.lattice, finest)]

    def min_corners_of(self, board: Board) -> int:
        """Return the smallest number of points of a reported detection of `board`, which may be small.

        Half of a ChArUco board is enough, as markers name its corners.
        """
        least = max(board.corner_count // 2, MIN_MARKED) if board.pattern.type == Charuco.type else board.corner_count
        return min(self.min_corners, least)

    @property
    def min_corners_seen(self) -> int:
        """Corners of the smallest lattice searched for: a whole board may have fewer than `min_corners`. Below
        MIN_BOARD_CORNERS lattices may have two rows, as boards with markers."""
        whole = (max(columns * rows, MIN_BOARD_CORNERS) for columns, rows in self.chessboard_sizes)
        marked = [board for board in self.boards if board.pattern.type == Charuco.type]
        strips = (min(board.corner_count, MIN_BOARD_CORNERS - 1) for board in marked if min(board.size) < MIN_ROWS)
        return min([self.min_corners, *whole, *map(self.min_corners_of, marked), *strips])

    def _found_lattices(self) -> list[RefinedLattice]:
        plain = all(board.pattern.type == Chessboard.type for board in self.boards)
        only = self.chessboard_sizes if plain else ()
        marked = [board for board in self.boards if board.pattern.type == Charuco.type]
        has_markers = functools.partial(has_markers_of, marked) if marked else None
        seen = SearchedImage.of(self.grey)
        found = find_lattices(self.grey, self.min_corners_seen, only, has_markers=has_markers, searched=seen)
        if marked and not self.quick and self.grey.size < BASE_PIXELS and _may_miss_squares(found, marked):
            every = find_lattices(
                self.grey, self.min_corners_seen, has_markers=has_markers, searched=seen.with_enlarged()
            )
            found = max(found, every, key=corner_count)
        if not found and plain and not self.quick and self.grey.size > BASE_PIXELS:
            # Squares of 6 px of a 4K image are of 3 px in the finest level. Patterns as fine have the more places where
            # a few squares alternate by chance.
            least = max(self.min_corners_seen, min([BY_CHANCE, *(board.corner_count for board in self.boards)]))
            larger = seen.with_fine_squares()
            found = find_lattices(self.grey, least, only, searched=larger) if larger else []
        if not found and self.grey.dtype != np.uint8:
            # In images of more than 8 bits a board may use a hundredth of the range of brightness.
            even = [item.lattice for item in find_lattices(equalised(self.grey), self.min_corners_seen, only)]
            # Equalisation shifts corners beside bright objects: they are fitted on a linearly stretched image.
            self.grey = stretched(self.grey, [lattice.pixels for lattice in even])
            found = fit_and_confirm(self.grey, even, BoardCriteria(self.min_corners_seen, only, has_markers))
        return found


def _may_miss_squares(found: Sequence[RefinedLattice], boards: Sequence[Board]) -> bool:
    """Return whether boards with markers may have corners that were not `found` because their squares are small."""
    small = all(
        known_median(fit_cells(item.lattice.pixels, item.lattice.known).gaps()) < SMALL_SQUARE_PX for item in found
    )
    sizes = {frozenset(board.size) for board in boards}
    return small and not any(item.lattice.known.all() and frozenset(item.lattice.size) in sizes for item in found)


class Finder(ABC):
    """Finds the boards of one pattern. A new one needs a module and a line in `registry`."""

    @abstractmethod
    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        """Return the detections of `boards`, the listed ones with this finder's pattern, with missed corners added.

        A detection has an id if the image determines it, see `detect_boards`. A calibrated camera (`search.camera`)
        predicts missed points and the curvature of lines.
        """
