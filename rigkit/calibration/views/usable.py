"""The views that a calibration can use, and the reasons for the others."""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Pixels
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, BoardView
from rigkit.core.errors import InputError
from rigkit.core.identifiers import MAX_IDENTIFIER, is_identifier
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.circles import Circles

MIN_CORNERS_OF_VIEW = 6
"""A pose has six parameters: fewer corners give no check of it."""
OFTEN = 3
"""Number of whole grids of one size that make a board: parts of a larger board, cut by the frame, have many sizes."""
MIN_SHARE_LARGER = 0.25
"""Part of all images with a whole larger grid instead of a declared board, from which that is the board."""
TOUCHING = 1.7
"""Largest distance of neighbours on one lattice over the smallest one there: slanted squares."""
MAX_SHARE_REACHING = 0.1
"""Part of all images in which a false corner beside a smaller board may extend it to the size of a declared one."""
MAX_SHARE_COPIES = 0.25
"""Part of the images with whole boards in which there are more than declared, from which there are copies of them."""
MIN_TIMES_LARGER = 2.0
"""Length of the board in the image over that of a picture of one in the background; below it both may be boards."""
OTHER_GRIDS = "grids beside the whole board, which may be parts of another or something else"
"""Reason why a grid in a used image gives no view."""
MIN_SCATTER_RATIO = 1e-6
"""Determinant of the corners' scatter over its squared trace from which they are not collinear: less is rounding (of a
row of the board) or noise (of a board seen edge-on, a thousandth as high as wide)."""


PART = re.compile(r" part (of .+|[0-9a-f]{8})$")
"""End of the name of a part of a board: see `views_of_image`."""


def usable_views(
    views: Sequence[BoardView], size_px: tuple[int, int]
) -> tuple[list[BoardView], tuple[tuple[str, str], ...]]:
    """Return the views with enough corners, and (image, reason) of the others.

    Raises InputError where no view is left, or corners lie outside the image: then the images are of another size.
    """
    if not views:
        raise InputError("calibration: no views; at least one image in which a board was found is needed")
    corners = np.concatenate([view.pixels for view in views])
    if not _inside(corners, size_px):
        outside = [view.image for view in views if not _inside(view.pixels, size_px)]
        more = f" and {len(outside) - 1} more" if len(outside) > 1 else ""
        raise InputError(
            f"image '{outside[0]}'{more}: corners outside {size_px[0]}x{size_px[1]} px; all images of a session must "
            "have that size"
        )
    used, dropped = [], []
    count = np.array([len(view.grid) for view in views])
    of_board = _on_a_line(np.concatenate([view.grid for view in views]).astype(np.float64), count)
    for view, on_board, in_image in zip(views, of_board, _on_a_line(corners, count), strict=True):
        reason = _reason(view, "board" if on_board else "image" if in_image else None)
        if reason is None:
            used.append(view)
        else:
            dropped.append((view.image, reason))
    if not used:
        raise InputError(
            f"calibration: none of {len(views)} views can be used; the first: {dropped[0][1]}; "
            "check columns and rows of the board"
        )
    return used, tuple(dropped)


def _inside(pixels: Pixels, size_px: tuple[int, int]) -> bool:
    return bool(((pixels >= -0.5) & (pixels <= np.array(size_px) - 0.5)).all())


def _on_a_line(points: FloatArray, count: IntArray) -> list[bool]:
    """Return for each view whether its points, `count` (V,) of the points (N, 2), are collinear or coincide."""
    owner = np.repeat(np.arange(len(count)), count)
    mean = [np.bincount(owner, axis, len(count)) / np.maximum(count, 1) for axis in points.T]
    x, y = points[:, 0] - mean[0][owner], points[:, 1] - mean[1][owner]
    xx, xy, yy = (np.bincount(owner, product, len(count)) for product in (x * x, x * y, y * y))
    line: list[bool] = (xx * yy - xy * xy <= MIN_SCATTER_RATIO * (xx + yy) ** 2).tolist()
    return line


def _reason(view: BoardView, line_of: str | None) -> str | None:
    if len(view.grid) < MIN_CORNERS_OF_VIEW:
        return f"{len(view.grid)} corners of board '{view.board.board_id}', at least {MIN_CORNERS_OF_VIEW} are needed"
    if line_of is not None:
        return f"the corners of board '{view.board.board_id}' lie on one line of the {line_of}"
    return None


def other_size(
    detections: Mapping[str, Sequence[BoardDetection]], boards: Sequence[Board], about: Sequence[Board] = ()
) -> str | None:
    """Return words for the size of the boards in a session's images (name -> detections), if it is clearly not a
    declared one, else None. One detection is enough for the size of a board in `about`, which is known to be there.

    The size is another one if most images have a whole grid of it and hardly any grid is as large as a declared board
    (a smaller board passes for part of a declared one). It is another one, too, if images have whole grids larger than
    a declared board and never that board: in the other images it was part of a larger board.
    """
    listed = {frozenset(board.size) for board in boards}
    found = [_extents_in_image(own) for own in detections.values() if own]
    # Sizes in the units of each pattern: tags, not the corners of tags.
    declared = sorted(boards, key=lambda board: board.size)
    sizes = ", ".join(dict.fromkeys(b.describe().split(", ")[0].removesuffix(" inner corners") for b in declared))
    without = [own for own in found if not any(frozenset(seen.size) in listed for seen in own)]
    counts = Counter((max(s.size), min(s.size)) for own in without for s in own if s.whole)
    size, count = counts.most_common(1)[0] if counts else ((0, 0), 0)
    # As many columns as rows, or more, unless all declared boards have fewer.
    columns, rows = size if any(board.columns >= board.rows for board in boards) else size[::-1]
    circles = all(board.pattern.point_word == "circles" for board in boards)
    seen_words = f"{columns} x {rows} {'circles' if circles else 'inner corners'} are seen"
    words = f"{seen_words} in {count} of {len(found)} images, {sizes} are declared"
    if count < (1 if any(frozenset(size) == frozenset(board.size) for board in about) else OFTEN):
        return None
    reaching = [own for own in found if any(frozenset(seen.reach) in listed for seen in own)]
    if len(reaching) <= MAX_SHARE_REACHING * len(found):
        return words if 2 * count > len(found) else None
    larger = any(max(board.size) <= size[0] and min(board.size) <= size[1] for board in boards)
    return words if larger and count >= MIN_SHARE_LARGER * len(found) else None


def without_lookalikes(
    detections: Mapping[str, Sequence[BoardDetection]], boards: Sequence[Board]
) -> dict[str, tuple[BoardDetection, ...]]:
    """Return the detections of a session's images (name -> detections) without possible parts of boards in images where
    all boards of the session are detected whole: they may be a tiled floor or a patterned box.

    If many images have more whole boards than declared, there are copies of them, and parts are kept. If only a few
    have, a much smaller board is taken for a picture of one: it is left out, and the large one is named as the board.
    """
    listed = {frozenset(board.size) for board in boards}
    whole = {
        name: [d.board_id is not None or (d.complete and frozenset((d.columns, d.rows)) in listed) for d in own]
        for name, own in detections.items()
    }
    counts = [sum(own) for own in whole.values() if any(own)]
    copies = sum(count > len(boards) for count in counts) > MAX_SHARE_COPIES * len(counts)
    if copies:
        return {name: tuple(own) for name, own in detections.items()}
    out = {}
    for name, own in detections.items():
        full = sum(whole[name]) >= len(boards)
        kept = [d for d, is_whole in zip(own, whole[name], strict=True) if is_whole or not full]
        for board in boards:
            if not board.identified and sum(set(board.size) == set(other.size) for other in boards) == 1:
                kept = _without_small_copies(kept, board)
        out[name] = tuple(kept)
    return out


def _without_small_copies(found: Sequence[BoardDetection], board: Board) -> list[BoardDetection]:
    """Return the detections of an image without whole grids of the board's size that are much smaller in the image than
    the largest; if only that is left it gets the board's name."""
    alike = [d for d in found if d.board_id is None and d.complete and (d.columns, d.rows) == board.size]
    if len(alike) < 2:
        return list(found)
    length = np.array([float(np.linalg.norm(np.ptp(d.pixels, axis=0))) for d in alike])
    small = [d for d, much in zip(alike, MIN_TIMES_LARGER * length <= length.max(), strict=True) if much]
    kept = [d for d in found if all(d is not one for one in small)]
    if len(small) + 1 < len(alike):
        return kept
    largest = alike[int(length.argmax())]
    return [d.named(board.board_id) if d is largest else d for d in kept]


@dataclass(frozen=True, slots=True)
class _Extent:
    """A grid in an image: its size, the columns and rows from its first corner to its last, whether it is complete."""

    size: tuple[int, int]
    reach: tuple[int, int]
    whole: bool


def _extents_in_image(own: Sequence[BoardDetection]) -> list[_Extent]:
    """Return the grids of an image; two that touch along a whole side are merged."""
    seen = [_Extent((one.columns, one.rows), _reach(one), one.complete) for one in own]
    for i, j in combinations(range(len(own)), 2):
        sides = set(seen[i].size) & set(seen[j].size)
        touching = _touching(own[i], own[j]) if sides else 0
        side = next((side for side in sides if side - 1 <= touching <= side), None)
        if side is not None:
            size = sum(own[k].columns * own[k].rows for k in (i, j)) // side, side
            others = [seen[k] for k in range(len(own)) if k not in (i, j)]
            return [_Extent(size, size, seen[i].whole and seen[j].whole), *others]
    return seen


def _touching(one: BoardDetection, other: BoardDetection) -> int:
    """Return how many corners of `one` have a corner of `other` at the distance of their own neighbours."""
    own = np.linalg.norm(one.pixels[:, None] - one.pixels, axis=-1)
    np.fill_diagonal(own, np.inf)
    distance = np.linalg.norm(one.pixels[:, None] - other.pixels, axis=-1).min(axis=1)
    return int(((distance > 0.5 * own.min(axis=1)) & (distance < TOUCHING * own.min(axis=1))).sum())


def _reach(found: BoardDetection) -> tuple[int, int]:
    """Return the columns and rows from the first corner found to the last."""
    columns, rows = (np.ptp(found.grid, axis=0) + 1).tolist()
    return columns, rows


def views_of_image(
    image: str, detections: Sequence[BoardDetection], boards: Sequence[Board], camera: str | None = None
) -> tuple[list[BoardView], str | None]:
    """Return the views of an image, or the reason why it has none; `camera` is the image's camera, of several.

    A detection that could be one of several boards, or part of one, is still a flat grid of known points. It becomes a
    view of a separate board named "<board> part of <image>", with the camera's name, as images of two cameras may have
    the same name.
    """
    views: list[BoardView] = []
    other: list[str] = []
    for k, found in enumerate(detections):
        if found.board_id is not None:
            views.append(BoardView.from_detection(image, found, boards))
            continue
        parent, turned = _parent(found, boards)
        if parent is None:
            other.append(f"{found.columns}x{found.rows}")
            continue
        of = image if camera is None else f"{image} of {camera}"
        name = _part_name(parent.board_id, of, k + 1 if len(detections) > 1 else None)
        sides = parent.square_x_mm, parent.square_y_mm
        # Where marks would say which part it is none was read: it is a chessboard.
        pattern = Chessboard() if parent.identified else parent.pattern
        sigma_mm = parent.square_sigma_mm
        part = Board(name, turned.columns, turned.rows, *sides, square_sigma_mm=sigma_mm, pattern=pattern)
        views.append(BoardView(image, part, turned.grid, turned.pixels, turned.sigma_px))
    if views:
        return views, None
    sizes = ", ".join(f"{b.columns}x{b.rows}" for b in boards)
    return [], f"found only {', '.join(other)} corners, the board has {sizes}" if other else "no board found"


def _part_name(board_id: str, image: str, number: int | None) -> str:
    """Return a valid name for a part of a board, a different one for every image."""
    name = f"{board_id} part of {image}" + (f" ({number})" if number else "")
    return name if is_identifier(name) else f"{board_id[: MAX_IDENTIFIER - 20]} part {zlib.crc32(name.encode()):08x}"


def without_parts(boards: Iterable[Board]) -> tuple[Board, ...]:
    """Return the boards without those that are parts of others by their name: they do not exist by themselves."""
    return tuple(board for board in boards if PART.search(board.board_id) is None)


def _parent(found: BoardDetection, boards: Sequence[Board]) -> tuple[Board | None, BoardDetection]:
    """Return the smallest board that the detection can be part of, and the detection turned to its axes."""
    for board in sorted(boards, key=lambda b: b.corner_count):
        square = board.square_x_mm == board.square_y_mm
        staggered = isinstance(board.pattern, Circles) and board.pattern.staggered
        for turns in (0,) if staggered else (0, 1):
            turned = found.turned(turns)
            fits = turned.columns <= board.columns and turned.rows <= board.rows
            if fits and (square or (turned.columns, turned.rows) == board.size):
                return board, turned
    return None, found
