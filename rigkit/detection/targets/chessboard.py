"""Chessboards: the lattices of the image, on the grids of the listed boards where their position is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.checks.border import place_part
from rigkit.detection.checks.validate import part_of_known_size
from rigkit.detection.guided.guided import completed
from rigkit.detection.guided.rejoin import rejoined
from rigkit.detection.guided.relit import relit
from rigkit.detection.lattice.origin import quarter_turns
from rigkit.detection.new_corners import same_corner_px
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.resampled import Resampled
from rigkit.detection.targets.base import Finder, Search
from rigkit.kernels.front import near_any

SEEN_OF_LINE = 0.5
"""Smallest difference in the share of a missed row's corners found on one side of a lattice and on the other. On the
right side it is 0.5 and more (motion of 15 px), beyond the border 0."""


CLEARLY_MORE_CERTAIN = 2.0
"""Smallest ratio of the sigmas of a board fitted in the image, with a camera's help, to those in a resampled part for
the latter to count: both are of the same pixels, the camera adds knowledge of the lines, and its sigmas include errors
of the lens model and the print. Of REAL boards made worse (camodocal, blur 4 px) corners are off by 0.139 px instead of
0.183; others change by less than a tenth."""


class ChessboardFinder(Finder):
    """Returns all lattices that no other finder has used, of any size."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        # The search may stretch the image to the levels of its lattices, which clips those of corners that it missed.
        grey = search.grey
        # The camera predicts corners in the image itself, not in resampled parts.
        plain = [item for item in search.lattices if item.picture is None or search.camera is not None]
        out = _in_image(grey, plain, boards, search.camera, quick=search.quick)
        for item in search.lattices:
            if (picture := item.picture) is not None:
                there = _in_image(grey, [item], boards, picture=picture, quick=search.quick)
                # Corners that are too oblique in the resampled part may be found in the image itself.
                mine = [completed(grey, _out_of(picture, found), boards, None) for found in there]
                same_px = same_corner_px(item.lattice)
                out = out + mine if search.camera is None else _with_more_certain(out, mine, same_px)
        return out


def _with_more_certain(
    found: Sequence[BoardDetection], others: Sequence[BoardDetection], same_px: float
) -> list[BoardDetection]:
    """Return `found` with `others` in place of those of mostly the same corners that are far less certain."""
    out = list(found)
    for other in others:
        same = [one for one in out if 2 * int(near_any(one.pixels, other.pixels, same_px).sum()) > len(one.grid)]
        if CLEARLY_MORE_CERTAIN**2 * sum(_information(one) for one in same) < _information(other):
            out = [one for one in out if not any(one is less for less in same)] + [other]
    return out


def _information(found: BoardDetection) -> float:
    # Of typical corners: a few that look far more certain than the others would outweigh these.
    return len(found.grid) / float(np.median(found.sigma_px)) ** 2


def _in_image(
    grey: GreyImage,
    found: Sequence[RefinedLattice],
    boards: Sequence[Board],
    camera: Camera | None = None,
    *,
    picture: Resampled | None = None,
    quick: bool,
) -> list[BoardDetection]:
    """Return the lattices `found` in an image as detections on the boards' grids, with missed corners added.

    With `picture`, corners are added in that resampled part, in whose pixels the result is; the borders of boards are
    evaluated in the image itself.
    """
    sizes = tuple(dict.fromkeys(board.size for board in boards))
    lattices = [part_of_known_size(item, sizes) for item in found]
    placed = _placed(grey, lattices, boards, camera)
    if picture is not None:
        grey, placed = picture.grey, [item.within(picture) for item in placed]
    turned = [item.turned(quarter_turns(item.lattice, sizes)) for item in placed]
    every = [completed(grey, _detection(item), boards, camera) for item in turned]
    return every if quick else [relit(grey, *pair) for pair in zip(every, turned, strict=True)]


def _out_of(picture: Resampled, found: BoardDetection) -> BoardDetection:
    """Return a detection in a resampled part of an image in pixels of the image."""
    return replace(found, pixels=picture.back(found.pixels), sigma_px=picture.sigma_factor * found.sigma_px)


def _placed(
    grey: GreyImage, lattices: Sequence[RefinedLattice], boards: Sequence[Board], camera: Camera | None
) -> list[RefinedLattice]:
    """Return the lattices, those of parts of a board on the grid of the whole board where their position is known."""
    sizes = tuple(dict.fromkeys(board.size for board in boards))
    tried = [(item, place_part(grey, item, sizes) or _with_missed_line(grey, item, boards)) for item in lattices]
    placed = [item for _, item in tried if item is not None]
    parts = [item for item, known in tried if known is None]
    if camera is None or len(parts) < 2:
        return [*placed, *parts]
    return [*placed, *(place_part(grey, item, sizes) or item for item in rejoined(parts, boards, camera))]


def _with_missed_line(grey: GreyImage, item: RefinedLattice, boards: Sequence[Board]) -> RefinedLattice | None:
    """Return a lattice that lacks one row or column of a board on the board's grid; None if its position is ambiguous.

    With blur and motion the border of the board is not visible (`place_part`), but some of the missed corners are.
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
