"""Finding every board of an image: chessboards without being told a size, and any target that is listed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.saddles.bad_pixels import without_bad_pixels
from rigkit.detection.saddles.mosaic import without_mosaic
from rigkit.detection.saddles.response import grey_image
from rigkit.detection.targets.base import Search
from rigkit.detection.targets.registry import FINDERS, check_searchable
from rigkit.kernels.front import near_any

SAME_CORNER_PX = 2.0
"""Corners of two detections nearer than this are one corner."""


def detect_boards(
    image: NDArray[np.generic],
    boards: Sequence[Board] | None = None,
    *,
    min_corners: int = 12,
    camera: Camera | None = None,
    quick: bool = False,
) -> tuple[BoardDetection, ...]:
    """Find every board of `image`: chessboards of any size, or what is listed.

    Parameters
    ----------
    image : (H, W) or (H, W, 3 or 4), uint8 or uint16 (or float 0..255), grey or RGB, or the mosaic of a colour camera.
    boards : what may be in the image, if known. A grid of a board's size, either way round, is turned to its columns x
        rows; a part of a board whose borders show where it lies gets its place in the board's grid, any other part
        stays a grid of its own. A board is named by its marks, or where one single given board has that size and one
        single detection fits it: whole, if others lack corners that would lie in the image. A grid of circles is named
        where it cannot be the visible part of a larger board that the image's border cuts off.
    min_corners : boards with fewer corners are not reported, but for whole ones of `boards`.
    camera : the calibrated camera, if known: it shows which parts are of one board (`guided.rejoin`) and where
        corners of known boards were missed, and fits all of them with windows and lines as it sees them
        (`guided.guided`).
    quick : points to a tenth of a pixel or so are enough: circles take half the time.

    Returns
    -------
    Detections by falling number of corners, then from top to bottom and left to right. Grids are right-handed; the
    first corner follows the convention of `rigkit.detection.lattice.origin`.

    Raises
    ------
    InputError
        `image` is not an image of a supported type, or nothing looks for the pattern of one of `boards`.
    """
    check_searchable(boards or ())
    stored = without_mosaic(grey_image(image))
    search = Search(without_bad_pixels(stored), boards or (), min_corners, camera, stored, quick=quick)
    found: list[BoardDetection] = []
    for kind, finder in FINDERS.items():
        own = [board for board in search.boards if board.pattern.type == kind]
        # Boards beside those listed cost nothing where chessboards were looked for anyway.
        if own or (kind == Chessboard.type and (search.has_lattices or not search.boards)):
            found += finder.find(search, own)
    sizes = search.chessboard_sizes
    if search.min_corners_seen < min_corners:
        found = [item for item in found if len(item.grid) >= min_corners or _whole(item, sizes)]
    ordered = sorted(found, key=_rank) if len(found) > 1 else found
    # Grids of circles are named where they are placed, and not where a larger board may be meant.
    plain = [board for board in search.boards if board.pattern.type == Chessboard.type]
    return tuple(_with_ids(_without_repeated(ordered), plain, (stored.shape[1], stored.shape[0])))


def _whole(item: BoardDetection, sizes: Sequence[tuple[int, int]]) -> bool:
    return item.complete and (item.columns, item.rows) in sizes


def _rank(item: BoardDetection) -> tuple[int, float, float]:
    u, v = item.pixels.mean(axis=0)
    return -len(item.grid), round(float(v), 3), round(float(u), 3)


def _without_repeated(found: Sequence[BoardDetection]) -> list[BoardDetection]:
    """Return those of `found`, the largest first, that are not for the most part corners of one before them.

    A board that something lies across is found in parts; the largest, completed, has the corners of the others.
    """
    if len(found) < 2:
        return list(found)
    low, high = (np.array([f(item.pixels, axis=0) for item in found]).reshape(-1, 2) for f in (np.min, np.max))
    touching = np.asarray(((low[:, None] < high + SAME_CORNER_PX) & (low < high[:, None] + SAME_CORNER_PX)).all(axis=2))
    kept: list[int] = []
    for k, item in enumerate(found):
        others = (found[j] for j in kept if touching[j, k])
        again = (np.count_nonzero(near_any(item.pixels, other.pixels, SAME_CORNER_PX)) for other in others)
        if not any(2 * int(count) > len(item.pixels) for count in again):
            kept.append(k)
    return [found[k] for k in kept]


def _cut_by_frame(item: BoardDetection, size_px: tuple[int, int]) -> bool:
    """Return whether most of the corners that `item` lacks are not in the image, whose (width, height) is `size_px`."""
    lattice = item.lattice()
    missing = fit_cells(lattice, np.isnan(lattice[..., 0]), degree=1).pixels
    return 2 * int(np.count_nonzero(((missing < 0.0) | (missing > np.array(size_px) - 1.0)).any(axis=1))) > len(missing)


def _with_ids(found: list[BoardDetection], boards: Sequence[Board], size_px: tuple[int, int]) -> list[BoardDetection]:
    """Return `found` with the names of those boards that only one detection, and that only this board, can be.

    A whole board is it rather than a grid that lacks corners within the image: a floor or a shirt has patches of any
    size. One that the frame cuts may be a copy.
    """
    out = list(found)
    for board in boards:
        same_size = [other for other in boards if set(other.size) == set(board.size)]
        fitting = [i for i, item in enumerate(found) if (item.columns, item.rows) == board.size]
        if any(found[i].complete for i in fitting):
            fitting = [i for i in fitting if found[i].complete or _cut_by_frame(found[i], size_px)]
        if len(same_size) == 1 and len(fitting) == 1:
            out[fitting[0]] = found[fitting[0]].named(board.board_id)
    return out
