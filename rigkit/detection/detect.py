"""Finding every chessboard of an image: loose corners, links, lattices, growth, the sub-pixel fit, and what is a board.

No size need be known, no number of boards, no lens.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.arrays import IntArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.checks.border import place_part
from rigkit.detection.checks.discontinuity import may_be_discontinuous, split_at_discontinuities, without_outliers
from rigkit.detection.checks.validate import (
    compact,
    has_edge_offset,
    known_part,
    large,
    sample_of,
    separate,
    tidy,
    too_large,
    trustworthy,
)
from rigkit.detection.guided.guided import complete_boards
from rigkit.detection.guided.rejoin import rejoined
from rigkit.detection.lattice.grow import grow_all
from rigkit.detection.lattice.lattice import Lattice, build_lattices
from rigkit.detection.lattice.links import find_links
from rigkit.detection.lattice.origin import quarter_turns
from rigkit.detection.lattice.split import join_parts, split_at_turns, split_necks
from rigkit.detection.saddles.bad_pixels import without_bad_pixels
from rigkit.detection.saddles.local_contrast import equalised, stretched
from rigkit.detection.saddles.nearby import near_any
from rigkit.detection.saddles.response import GreyImage, Level, grey_image, pyramid
from rigkit.detection.saddles.saddle import find_corners
from rigkit.detection.subpixel.subpixel import RefinedLattice, refine

__all__ = ["MIN_BOARD_CORNERS", "detect_boards"]

MIN_PART_CORNERS = 6
"""Corners of the smallest part of a board that something lies across."""

MIN_BOARD_CORNERS = 9
"""Fewer than 3 x 3 corners are too often no board."""

SAME_CORNER_PX = 2.0
"""Corners of two detections nearer than this are one corner."""


def find_lattices(
    image: NDArray[np.generic], min_corners: int, sizes: Sequence[tuple[int, int]] = ()
) -> list[RefinedLattice]:
    """Return the lattices of all boards of `image`, refined, in no particular order and orientation.

    `sizes` : (columns, rows) of all boards that may be in it, if known.
    """
    grey = grey_image(image)
    size_px = (grey.shape[1], grey.shape[0])
    found = _fitted(grey, candidates(grey, min_corners, _promising), min_corners, sizes)
    return [item for item in found if min_corners < MIN_BOARD_CORNERS or compact(item.lattice, size_px)]


def candidates(
    grey: GreyImage, min_corners: int, promising: Callable[[GreyImage, Level, Lattice], bool]
) -> list[Lattice]:
    """Return the lattices of `grey` that may be boards, before the sub-pixel fit.

    `promising` says of a lattice, on the image and the finest level of its pyramid, whether it is worth growing.
    """
    size_px = (grey.shape[1], grey.shape[0])
    levels = pyramid(grey)
    corners, saddles = find_corners(levels)
    lattices = build_lattices(corners, find_links(corners, levels[0]))
    grown = grow_all(lattices, saddles, levels[0], functools.partial(promising, grey, levels[0]))
    grown = [item for item in grown if item.count >= MIN_PART_CORNERS]
    if not any(item.solid or min_corners < MIN_BOARD_CORNERS for item in grown):
        return []
    boards = [board for item in grown for part in split_at_turns(item) for board in split_necks(part)]
    parts = separate([tidy(board, size_px) for board in boards], MIN_PART_CORNERS)
    return [board for board in join_parts(parts) if large(board, min_corners)]


def _fitted(
    grey: GreyImage, boards: Sequence[Lattice], min_corners: int, sizes: Sequence[tuple[int, int]]
) -> list[RefinedLattice]:
    """Return those of `boards` that the fit confirms, refined, without what belongs to others that they touch."""
    refined = zip(boards, refine(grey, boards), strict=True)
    size_px = (grey.shape[1], grey.shape[0])
    out = []
    for item in (after for before, after in refined if trustworthy(after, before.count, min_corners)):
        own = without_outliers(item, size_px)
        parts = (
            split_at_discontinuities(own, several=too_large(own.lattice, sizes))
            if may_be_discontinuous(item, size_px)
            else [own]
        )
        if len(parts) == 1:
            out += [own] if large(own.lattice, min_corners) else []
            continue
        # The edges on the other side of a seam had a say in these corners.
        alone = [part.lattice.trimmed() for part in parts]
        out += _fitted(grey, [part for part in alone if large(part, min_corners)], min_corners, sizes)
    return out


def _promising(grey: GreyImage, finest: Level, lattice: Lattice) -> bool:
    """Return whether `lattice` may be a board, as far as a quick look at its edges and a sample of it tell."""
    if lattice.solid and has_edge_offset(lattice, finest):
        return False
    sample = sample_of(lattice)
    if sample is None:
        return True
    (refined,) = refine(grey, [sample])
    return trustworthy(refined, sample.count, 0)


def detect_boards(
    image: NDArray[np.generic],
    boards: Sequence[Board] | None = None,
    *,
    min_corners: int = 12,
    camera: Camera | None = None,
) -> tuple[BoardDetection, ...]:
    """Find every chessboard of `image`.

    Parameters
    ----------
    image : (H, W) or (H, W, 3 or 4), uint8 or uint16 (or float 0..255), grey or RGB.
    boards : what may be in the image, if known. A grid of a board's size, either way round, is turned to its columns x
        rows; a part of a board whose borders show where it lies gets its place in the board's grid, any other part
        stays a grid of its own. A board is named only where one single given board has that size and one single
        detection fits it, or, a ChArUco board, by its markers.
    min_corners : boards with fewer corners are not reported, but for whole ones of `boards`.
    camera : the calibrated camera, if known: it shows which parts are of one board (`guided.rejoin`) and where
        corners of known boards were missed, and fits all of them with windows and lines as it sees them
        (`guided.guided`).

    Returns
    -------
    Detections by falling number of corners, then from top to bottom and left to right. Grids are right-handed; the
    first corner follows the convention of `rigkit.detection.lattice.origin`.

    Raises
    ------
    InputError
        `image` is not an image of a supported type.
    """
    known = boards or ()
    plain = [board for board in known if board.markers is None]
    sizes = tuple(dict.fromkeys(board.size for board in plain))
    grey = without_bad_pixels(grey_image(image))
    fewest = min([min_corners, *(max(columns * rows, MIN_BOARD_CORNERS) for columns, rows in sizes)])
    only = sizes if len(plain) == len(known) else ()
    lattices = find_lattices(grey, fewest, only)
    if not lattices and grey.dtype != np.uint8:
        # Beyond 8 bits the squares of a board may be a hundredth of the range of brightness.
        seen = [item.lattice for item in find_lattices(equalised(grey), fewest, only)]
        # What is hot beside a board moves corners of the equalised image: they are placed on one that is only brighter.
        grey = stretched(grey, [lattice.pixels for lattice in seen])
        lattices = _fitted(grey, seen, fewest, only)
    marked: list[BoardDetection] = []
    if len(plain) < len(known):
        from rigkit.detection.charuco import charuco_boards

        marked, lattices = charuco_boards(grey, lattices, known, min_corners)
    lattices = [known_part(item, sizes) for item in lattices]
    placed = _placed(grey, lattices, plain, camera)
    found = complete_boards(grey, [*marked, *(_detection(item, sizes) for item in placed)], known, camera)
    if fewest < min_corners:
        found = tuple(item for item in found if len(item.grid) >= min_corners or _whole(item, sizes))
    ordered = sorted(found, key=_rank)
    return tuple(_with_ids(_without_repeated(ordered), plain))


def _whole(item: BoardDetection, sizes: Sequence[tuple[int, int]]) -> bool:
    return item.complete and (item.columns, item.rows) in sizes


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


def _rank(item: BoardDetection) -> tuple[int, float, float]:
    u, v = item.pixels.mean(axis=0)
    return -len(item.grid), round(float(v), 3), round(float(u), 3)


def _without_repeated(found: Sequence[BoardDetection]) -> list[BoardDetection]:
    """Return those of `found`, the largest first, that are not for the most part corners of one before them.

    A board that something lies across is found in parts; the largest, completed, has the corners of the others.
    """
    low, high = (np.array([f(item.pixels, axis=0) for item in found]).reshape(-1, 2) for f in (np.min, np.max))
    touching = np.asarray(((low[:, None] < high + SAME_CORNER_PX) & (low < high[:, None] + SAME_CORNER_PX)).all(axis=2))
    kept: list[int] = []
    for k, item in enumerate(found):
        others = (found[j] for j in kept if touching[j, k])
        again = (np.count_nonzero(near_any(item.pixels, other.pixels, SAME_CORNER_PX)) for other in others)
        if not any(2 * int(count) > len(item.pixels) for count in again):
            kept.append(k)
    return [found[k] for k in kept]


def _detection(refined: RefinedLattice, sizes: Sequence[tuple[int, int]]) -> BoardDetection:
    lattice, turns = refined.lattice, quarter_turns(refined.lattice, sizes)
    # The corners row by row as they will be counted.
    columns, rows = lattice.size
    cells: IntArray = np.rot90(np.arange(rows * columns).reshape(rows, columns), -turns)
    row, column = np.nonzero(lattice.known.ravel()[cells])
    order = cells[row, column]
    if turns % 2 == 1:
        columns, rows = rows, columns
    return BoardDetection(
        None,
        columns,
        rows,
        np.stack([column, row], axis=-1),
        lattice.pixels.reshape(-1, 2)[order],
        refined.sigma_px.ravel()[order],
    )


def _with_ids(found: list[BoardDetection], boards: Sequence[Board]) -> list[BoardDetection]:
    """Return `found` with the names of those boards that only one detection, and that only this board, can be."""
    out = list(found)
    for board in boards:
        same_size = [other for other in boards if set(other.size) == set(board.size)]
        fitting = [i for i, item in enumerate(found) if (item.columns, item.rows) == board.size]
        if len(same_size) == 1 and len(fitting) == 1:
            out[fitting[0]] = found[fitting[0]].named(board.board_id)
    return out
