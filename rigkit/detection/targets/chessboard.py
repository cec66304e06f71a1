"""Chessboards: the lattices of the image, on the boards' grids where that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.checks.border import place_part
from rigkit.detection.checks.validate import known_part
from rigkit.detection.guided.guided import completed
from rigkit.detection.guided.rejoin import rejoined
from rigkit.detection.guided.relit import relit
from rigkit.detection.lattice.origin import quarter_turns
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.resampled import Resampled
from rigkit.detection.targets.base import Finder, Search

SEEN_OF_LINE = 0.5
"""Part of a missed row or column whose corners are seen on one side of a lattice rather than on the other: measured 0.5
and more there (motion of 15 px), none beyond the border."""


class ChessboardFinder(Finder):
    """All lattices that no other target has taken, whatever their size."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        if search.camera is not None:
            # It says where corners are in the image itself.
            return _in_image(search.grey, search.lattices, boards, search.camera, quick=search.quick)
        out = _in_image(
            search.grey, [item for item in search.lattices if item.picture is None], boards, quick=search.quick
        )
        for item in search.lattices:
            if (picture := item.picture) is not None:
                there = _in_image(search.grey, [item], boards, picture=picture, quick=search.quick)
                # What is too much aslant there may still be seen in the image itself.
                out += [completed(search.grey, _out_of(picture, found), boards, None) for found in there]
        return out


def _in_image(
    grey: GreyImage,
    found: Sequence[RefinedLattice],
    boards: Sequence[Board],
    camera: Camera | None = None,
    *,
    picture: Resampled | None = None,
    quick: bool,
) -> list[BoardDetection]:
    """Return the boards that the lattices `found` in an image are, on their grids, completed: in `picture`, where that
    is given, and as they lie there. How a board ends is seen in the image itself."""
    sizes = tuple(dict.fromkeys(board.size for board in boards))
    lattices = [known_part(item, sizes) for item in found]
    placed = _placed(grey, lattices, boards, camera)
    if picture is not None:
        grey, placed = picture.grey, [item.within(picture) for item in placed]
    turned = [item.turned(quarter_turns(item.lattice, sizes)) for item in placed]
    every = [completed(grey, _detection(item), boards, camera) for item in turned]
    return every if quick else [relit(grey, *pair) for pair in zip(every, turned, strict=True)]


def _out_of(picture: Resampled, found: BoardDetection) -> BoardDetection:
    """Return what was found in a part of an image as it lies in the image."""
    return replace(found, pixels=picture.back(found.pixels), sigma_px=picture.sigma_factor * found.sigma_px)


def _placed(
    grey: GreyImage, lattices: Sequence[RefinedLattice], boards: Sequence[Board], camera: Camera | None
) -> list[RefinedLattice]:
    """Return the grids with those that are parts of a board in their place, where that is known."""
    sizes = tuple(dict.fromkeys(board.size for board in boards))
    tried = [(item, place_part(grey, item, sizes) or _with_missed_line(grey, item, boards)) for item in lattices]
    placed = [item for _, item in tried if item is not None]
    parts = [item for item, known in tried if known is None]
    if camera is None or len(parts) < 2:
        return [*placed, *parts]
    return [*placed, *(place_part(grey, item, sizes) or item for item in rejoined(parts, boards, camera))]


def _with_missed_line(grey: GreyImage, item: RefinedLattice, boards: Sequence[Board]) -> RefinedLattice | None:
    """Return a lattice that lacks one row or column of a board on the board's grid; None where that place is open.

    Blur and motion hide how a board ends (`place_part`), but the corners missed are seen on one side of the two.
    """
    options = []
    for board in boards:
        for size in {board.size, board.size[::-1]}:
            across, down = (whole - seen for whole, seen in zip(size, item.lattice.size, strict=True))
            if sorted((across, down)) != [0, 1]:
                continue
            for before in (0, 1):
                rows, columns = ((before * more, more - before * more) for more in (down, across))
                placed = item.padded(rows, columns)
                start = _detection(placed.turned(quarter_turns(placed.lattice, [board.size])))
                added = len(completed(grey, start, [board], None).grid) - len(start.grid)
                options.append((added / (size[1] if across else size[0]), placed))
    shares = sorted(share for share, _ in options)
    if len(options) < 2 or shares[-1] - shares[-2] < SEEN_OF_LINE:
        return None
    return max(options, key=lambda option: option[0])[1]


def _detection(found: RefinedLattice) -> BoardDetection:
    known = found.lattice.known
    grid = np.argwhere(known)[:, ::-1]
    return BoardDetection(None, *found.lattice.size, grid, found.lattice.pixels[known], found.sigma_px[known])
