"""The contract of every search for a kind of target, and what the searches of one image share."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.lattices import MIN_BOARD_CORNERS, Sought, find_lattices, fitted
from rigkit.detection.saddles.local_contrast import equalised, stretched
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.tags.in_squares import vouched_by_markers


class Search:
    """An image that is searched, and what more than one kind of target needs of it.

    Attributes
    ----------
    grey : grey levels 0..255.
    boards : all boards that may be there.
    min_corners : boards with fewer points are not reported, but for whole ones of `boards`.
    camera : the calibrated camera, if known.
    stored : the grey levels before bad pixels were replaced: modules of small markers look like these.
    quick : points to a tenth of a pixel or so are enough, if that takes less time.
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
        """Whether the lattices were looked for."""
        return self._lattices is not None

    @property
    def lattices(self) -> list[RefinedLattice]:
        """The lattices of chessboard corners in the image that no target has taken; looked for when first asked for."""
        if self._lattices is None:
            self._lattices = self._found_lattices()
        return self._lattices

    def leave(self, lattices: Sequence[RefinedLattice]) -> None:
        """Let only these lattices be there for other targets."""
        self._lattices = list(lattices)

    @property
    def min_corners_seen(self) -> int:
        """Corners that the smallest lattice of interest has: a whole board may have fewer than `min_corners`."""
        whole = (max(columns * rows, MIN_BOARD_CORNERS) for columns, rows in self.chessboard_sizes)
        return min([self.min_corners, *whole])

    def _found_lattices(self) -> list[RefinedLattice]:
        plain = all(board.pattern.type == Chessboard.type for board in self.boards)
        only = self.chessboard_sizes if plain else ()
        marked = [board for board in self.boards if board.pattern.type == Charuco.type]
        vouched = functools.partial(vouched_by_markers, marked) if marked else None
        found = find_lattices(self.grey, self.min_corners_seen, only, vouched=vouched)
        if not found and self.grey.dtype != np.uint8:
            # Beyond 8 bits the squares of a board may be a hundredth of the range of brightness.
            seen = [item.lattice for item in find_lattices(equalised(self.grey), self.min_corners_seen, only)]
            # What is hot beside a board moves corners of the equalised image: they are placed on one that is only
            # brighter.
            self.grey = stretched(self.grey, [lattice.pixels for lattice in seen])
            found = fitted(self.grey, seen, Sought(self.min_corners_seen, only, vouched))
        return found


class Finder(ABC):
    """How an image is searched for the boards of one pattern. Adding one is a file, and a line in `registry`."""

    @abstractmethod
    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        """Return what is seen of `boards`, those of this finder's pattern that may be there, corners completed.

        A detection is named where the image tells which board it is, or by nobody's name: see `detect_boards`. What a
        calibrated camera (`search.camera`) can tell is used: which points were missed, how lines bend.
        """
