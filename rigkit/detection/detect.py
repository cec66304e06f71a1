"""Detection of all boards in an image: chessboards of unknown size, and any listed target."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.fields import of_one_moment
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.repeated_lines import without_repeated_lines
from rigkit.detection.saddles.bad_pixels import without_bad_pixels
from rigkit.detection.saddles.mosaic import without_mosaic
from rigkit.detection.saddles.response import grey_image
from rigkit.detection.saddles.saddle import SAME_CORNER_PX
from rigkit.detection.targets.base import Search
from rigkit.detection.targets.registry import FINDERS, check_searchable
from rigkit.kernels.front import near_any


def detect_boards(
    image: NDArray[np.generic],
    boards: Sequence[Board] | None = None,
    *,
    min_corners: int = 12,
    camera: Camera | None = None,
    quick: bool = False,
) -> tuple[BoardDetection, ...]:
    """Return all boards in `image`: chessboards of any size, or the listed boards.

    Parameters
    ----------
    image : (H, W) or (H, W, 3 or 4), uint8 or uint16 (or float 0..255), grey or RGB, or the mosaic of a colour camera.
    boards : the boards that may be in the image, if known. A grid with a board's size, or with columns and rows
        swapped, is rotated to that board's columns x rows. A part of a board gets its position in the board's grid if
        its borders determine it, else it remains a grid of its own. A board is identified by its markers, or if it is
        the only listed board of its size and only one detection fits it, of several the only whole one. A grid of
        circles is identified unless it may be the visible part of a larger board that the image border cuts off.
    min_corners : smallest number of corners of a reported board, except whole ones of `boards`, and halves of ChArUco
        boards.
    camera : the calibrated camera, if known. It joins the parts of a partly covered board (`guided.rejoin`), predicts
        missed corners of known boards, and determines windows and line curvatures for their fit (`guided.guided`).
    quick : an accuracy of about a tenth of a pixel is enough: circles take half the time.

    Returns
    -------
    Detections by decreasing number of corners, then from top to bottom and left to right. Grids are right-handed; the
    first corner follows the convention of `rigkit.detection.lattice.origin`.

    Raises
    ------
    InputError
        `image` is not an image of a supported type, `boards` are not boards, or there is no finder for the pattern of
        one.
    """
    check_searchable(boards or ())
    found = _detected(image, boards or (), min_corners, camera, quick)
    before = without_repeated_lines(image) if isinstance(image, np.ndarray) and image.ndim > 1 else None
    if before is None:
        return found
    return before.better(found, _detected(before.image, boards or (), min_corners, None, quick))


def _detected(
    image: NDArray[np.generic], boards: Sequence[Board], min_corners: int, camera: Camera | None, quick: bool
) -> tuple[BoardDetection, ...]:
    """Return all boards in `image`, all of whose lines are the sensor's."""
    stored = of_one_moment(without_mosaic(grey_image(image)))
    search = Search(without_bad_pixels(stored), boards, min_corners, camera, stored, quick=quick)
    found: list[BoardDetection] = []
    for kind, finder in FINDERS.items():
        own = [board for board in search.boards if board.pattern.type == kind]
        # Chessboards that are not listed are returned too if lattices were searched for anyway.
        if own or (kind == Chessboard.type and (search.has_lattices or not search.boards)):
            found += finder.find(search, own)
    sizes = [board.size for board in search.boards]
    if search.min_corners_seen < min_corners:
        found = [item for item in found if item.board_id or len(item.grid) >= min_corners or _whole(item, sizes)]
    ordered = sorted(found, key=_rank) if len(found) > 1 else found
    # The finder of circles has identified its grids already.
    plain = [board for board in search.boards if board.pattern.type == Chessboard.type]
    return tuple(_with_ids(_without_repeated(ordered), plain, (stored.shape[1], stored.shape[0])))


def _whole(item: BoardDetection, sizes: Sequence[tuple[int, int]]) -> bool:
    return item.complete and (item.columns, item.rows) in sizes


def _rank(item: BoardDetection) -> tuple[int, float, float]:
    u, v = item.pixels.mean(axis=0)
    return -len(item.grid), round(float(v), 3), round(float(u), 3)


def _without_repeated(found: Sequence[BoardDetection]) -> list[BoardDetection]:
    """Return `found` (largest first) without detections most of whose corners belong to an earlier one.

    A partly covered board is found in parts; the largest part, once completed, contains the corners of the others.
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
    """Return whether most missing corners of `item` are outside the image, whose (width, height) is `size_px`."""
    lattice = item.lattice()
    missing = fit_cells(lattice, np.isnan(lattice[..., 0]), degree=1).pixels
    return 2 * int(np.count_nonzero(((missing < 0.0) | (missing > np.array(size_px) - 1.0)).any(axis=1))) > len(missing)


def _with_ids(found: list[BoardDetection], boards: Sequence[Board], size_px: tuple[int, int]) -> list[BoardDetection]:
    """Return `found` with ids where the match of board and detection is unique.

    Whole grids take precedence over grids that lack corners within the image, which may be patches of a floor or shirt.
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
