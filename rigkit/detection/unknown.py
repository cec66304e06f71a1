"""Determination of the board that images show, up to scale."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.circles import Circles
from rigkit.core.processes import in_threads
from rigkit.core.progress import Progress, silent
from rigkit.detection.checks.evidence import MIN_EXPECTED_CORNERS
from rigkit.detection.circles.unknown import CircleObservations, guessed_circles
from rigkit.detection.detect import detect_boards
from rigkit.detection.fields import of_one_moment
from rigkit.detection.saddles.mosaic import without_mosaic
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.tags.unknown_charuco import MarkerObservations, guessed_charuco
from rigkit.detection.tags.unknown_tags import ARUCO_TAGS, GuessedGrid, TagObservations, guessed_grids
from rigkit.detection.whole_charuco import choose_pattern, has_first_row, has_next_row
from rigkit.detection.whole_grids import (
    MIN_IMAGES_OF_GUESS,
    GridExtent,
    Size,
    board_size_in,
    grid_extent,
    other_sizes,
    whole_sizes,
)

LOOKING, READING = "identifying the board", "reading markers"
"""Names of the steps for progress."""

WITHIN_SQUARES = np.linspace(0.2, 0.8, 9)
"""Sample positions within a square, along either side."""

MAX_LEVEL_DIFFERENCE = 0.35
"""Largest range of the levels within an empty square, over the contrast, due to shading and noise; with a marker it is
1, or half of it when blurred."""

FEW_TAGS, OUTNUMBERED = 8, 2
"""Where an image shows fewer tags, markers are looked for, too, and tags are none if markers are more than OUTNUMBERED
times as many: four tags of a small family may be random modules of larger markers (white on black, 7 x 7 modules: in 1
of 4 RENDERED images, of 35 markers)."""

SAME_PRINTED_RATIO = 0.05
"""Largest difference between ratios measured in images and those of the print."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class BoardGuess:
    """A board that images show.

    Attributes
    ----------
    board : with squares, or tags, of 1 mm.
    images : indices of the images that show it.
    beside : other boards in the images; of chessboards the visible part.
    sizes : empty if the size of the board is known. Otherwise a lower bound of its columns and rows, or several
        possible sizes.
    edges_moved : light or ink has shifted the edges of tags in all images, so that the spacing is known only to some
        hundredths.
    other_border : another possible board, if the edges of tags are shifted so much that the width of their border is
        ambiguous.
    either_pattern : the images do not show the column in which the current pattern of a ChArUco board differs from that
        before OpenCV 4.6.
    marked : no image shows that the squares of this chessboard are empty: there may be markers that were not read.
    """

    board: Board
    images: tuple[int, ...]
    beside: tuple[Board, ...] = ()
    sizes: tuple[Size, ...] = ()
    edges_moved: bool = False
    other_border: Board | None = None
    either_pattern: bool = False
    marked: bool = False

    @property
    def determined(self) -> bool:
        return not self.sizes and not self.edges_moved and self.other_border is None


def guess_board(images: Sequence[GreyImage], progress: Progress = silent) -> BoardGuess | None:
    """Return the board that most of the images (grey levels 0..255) show; None if there is none.

    AprilGrids and ChArUco boards (also inverted, and of the pattern before OpenCV 4.6) are determined by their markers.
    Otherwise it is the largest chessboard that is in enough images, or a grid of circles in more images. The size of a
    chessboard that is whole in no image may follow from several images that show its sides. `progress` is called for
    every image.
    """
    # The pixels of a mosaic look like markers in every square, and lines of two moments like none.
    images = [of_one_moment(without_mosaic(image)) for image in images]
    tags, markers = TagObservations(), MarkerObservations()
    plain: list[list[GridExtent]] = []
    sure: list[int] = []
    for k, found in enumerate(in_threads(detect_boards, images)):
        progress(LOOKING, k, len(images))
        grids = [(one, seen) for one in found if (seen := grid_extent(one, images[k])) is not None]
        plain.append([seen for _, seen in grids])
        if any(_has_empty_squares(images[k], one) for one, _ in grids):
            sure.append(k)
    progress(LOOKING, len(images), len(images))
    read = 0
    for k in sorted(range(len(images)), key=sure.__contains__):
        # A tiled floor is a chessboard without markers in every image, but seldom of one size in most.
        if k in sure and not (tags.seen or markers.images) and _most_show_one_size(plain):
            break
        progress(READING, read, len(images))
        read += 1
        before = tags.count
        tags.look(k, images[k])
        if tags.count - before < FEW_TAGS:
            markers.look(k, images[k])
    guess = _guess_from_observations(images, plain, tags, markers, marked=not sure)
    if read:
        progress(READING, len(images), len(images))
    if guess is not None and guess.board.pattern.type == Chessboard.type:
        return replace(guess, marked=not sure)
    return guess


def _guess_from_observations(
    images: Sequence[GreyImage],
    plain: Sequence[Sequence[GridExtent]],
    tags: TagObservations,
    markers: MarkerObservations,
    *,
    marked: bool,
) -> BoardGuess | None:
    grids = guessed_grids(tags)
    outnumbered = max(markers.kinds.values(), default=0) > OUTNUMBERED * tags.count
    charuco = guessed_charuco(markers) if outnumbered or not grids else []
    if grids and not charuco:
        return _guess_from_grids(grids)
    if charuco:
        shown = [images[k] for k in markers.images]
        more = has_next_row(charuco[0], shown)
        while more and (taller := guessed_charuco(markers, charuco[0].rows + 1)):
            charuco, more = taller, has_next_row(taller[0], shown)
        board, sure = choose_pattern(charuco, shown)
        sizes = () if more is False and has_first_row(board, shown) else (board.size,)
        return BoardGuess(board=board, images=tuple(markers.images), sizes=sizes, either_pattern=not sure)
    guess = _guess_without_marks(images, plain)
    determined = guess is not None and guess.determined
    # There may be a chessboard in the background, or markers that were not read.
    unexplained = [k for k in range(len(images)) if guess is None or k not in guess.images]
    # The squares between the tags of an AprilGrid are empty.
    possibly_marked = marked or not _most_show_one_size(plain)
    possibly_marked &= guess is not None and guess.board.pattern.type == Chessboard.type
    if determined and not unexplained and not possibly_marked:
        return guess
    grids = _inverted_or_aruco_grids(images, unexplained or range(len(images)), determined=determined)
    return _guess_from_grids(grids) if grids else guess


def _inverted_or_aruco_grids(
    images: Sequence[GreyImage], some: Sequence[int], *, determined: bool
) -> list[GuessedGrid]:
    """Return the grids of tags that are white on black, if `some` of the images show tags; without any, and if no other
    board is `determined`, those of ArUco markers."""
    white = TagObservations(inverted=True)
    for k in some:
        white.look(k, images[k])
    for k in (k for k in range(len(images)) if white.seen and k not in some):
        white.look(k, images[k])
    grids = guessed_grids(white)
    # ArUco markers last, as those of ChArUco boards are in rows too.
    for inverted in (False, True) if not grids and not determined else ():
        aruco = TagObservations(ARUCO_TAGS, inverted=inverted)
        for k, image in enumerate(images):
            aruco.look(k, image)
        grids = grids or guessed_grids(aruco)
    return grids


def _guess_from_grids(grids: Sequence[GuessedGrid]) -> BoardGuess:
    first, *others = grids
    return BoardGuess(
        board=first.board,
        images=first.images,
        beside=tuple(grid.board for grid in others),
        edges_moved=first.edges_moved,
        other_border=first.other_border,
    )


def _has_empty_squares(image: GreyImage, found: BoardDetection) -> bool:
    """Return whether a lattice is certainly a chessboard: large, with empty squares."""
    if len(found.grid) < MIN_EXPECTED_CORNERS:
        return False
    pixels = found.lattice()
    v, u = WITHIN_SQUARES[:, None, None, None, None], WITHIN_SQUARES[None, :, None, None, None]
    top = (1.0 - u) * pixels[:-1, :-1] + u * pixels[:-1, 1:]
    bottom = (1.0 - u) * pixels[1:, :-1] + u * pixels[1:, 1:]
    places = ((1.0 - v) * top + v * bottom).reshape(len(WITHIN_SQUARES) ** 2, -1, 2)
    row, column = np.indices((found.rows - 1, found.columns - 1))
    seen = np.isfinite(places).all(axis=(0, 2))
    levels, odd = sample(image, places[:, seen]), ((row + column) % 2).ravel()[seen] == 1
    if not odd.any() or odd.all():
        return False
    contrast = abs(float(levels[:, odd].mean() - levels[:, ~odd].mean()))
    return all(float(np.median(np.ptp(levels[:, of], axis=0))) < MAX_LEVEL_DIFFERENCE * contrast for of in (odd, ~odd))


def _most_show_one_size(plain: Sequence[Sequence[GridExtent]]) -> bool:
    """Return whether at least half of the images, and at least MIN_IMAGES_OF_GUESS, show whole grids of one size."""
    counts = Counter(size for found in plain for size in whole_sizes(found))
    return max(counts.values(), default=0) >= max(0.5 * len(plain), MIN_IMAGES_OF_GUESS)


def _guess_without_marks(images: Sequence[GreyImage], plain: Sequence[Sequence[GridExtent]]) -> BoardGuess | None:
    """Return the chessboard, or grid of circles, that most of the images show; None if there is none."""
    circles, settled = CircleObservations(), _most_show_one_size(plain)
    for k, (image, found) in enumerate(zip(images, plain, strict=True)):
        if not (found and settled):
            circles.look(k, image)
    best = board_size_in(plain)
    grid = guessed_circles(circles)
    if grid is not None and (best is None or len(grid[1]) > len(best[1])):
        return BoardGuess(board=grid[0], images=grid[1])
    if best is not None:
        sizes, shown = best
        board = Board("board", *sizes[0], 1.0, 1.0)
        others = tuple(Board("board", *size, 1.0, 1.0) for size in other_sizes(plain, sizes[0], shown))
        return BoardGuess(board=board, images=shown, beside=others, sizes=sizes if len(sizes) > 1 else ())
    shown = tuple(k for k, found in enumerate(plain) if found)
    if len(shown) < 0.5 * len(plain) or not shown:
        return None
    least: Size = tuple(np.array([grid.size for found in plain for grid in found]).max(axis=0).tolist())
    return BoardGuess(board=Board("board", *least, 1.0, 1.0), images=shown, sizes=(least,))


def difference(guess: Board, declared: Board) -> str | None:
    """Return in words how a declared board differs from the one in the images; None if it does not."""
    seen, declared_pattern = guess.pattern, declared.pattern
    size = f"{guess.columns // seen.points_per_count} x {guess.rows // seen.points_per_count} {seen.count_word}"
    if type(seen) is not type(declared_pattern):
        word = "" if seen.type.endswith("board") else " board"
        return f'{_article(seen.type)}{word} of {size} is seen; set type = "{seen.type}"'
    if (
        isinstance(seen, Charuco | AprilGrid)
        and isinstance(declared_pattern, Charuco | AprilGrid)
        and seen.inverted != declared_pattern.inverted
    ):
        negation = "" if seen.inverted else "not "
        return f"black and white are {negation}exchanged: set inverted = {str(seen.inverted).lower()}"
    if isinstance(seen, Charuco) and isinstance(declared_pattern, Charuco):
        if seen.legacy != declared_pattern.legacy and guess.rows % 2 == 1:
            words = "this is the legacy pattern" if seen.legacy else "this is not the legacy pattern"
            return f"{words}: set legacy_pattern = {str(seen.legacy).lower()}"
        if seen.dictionary.rpartition("_")[0] != declared_pattern.dictionary.rpartition("_")[0]:
            return f'the markers are of {seen.dictionary}: set dictionary = "{seen.dictionary}"'
    if isinstance(seen, Circles) and isinstance(declared_pattern, Circles):
        layout = _first_difference(("layout", "inverted"), seen, declared_pattern)
        if layout is not None:
            return layout
    if set(guess.size) != set(declared.size) or (seen.identified and guess.size != declared.size):
        per = declared_pattern.points_per_count
        return f"{size} are seen, {declared.columns // per} x {declared.rows // per} are declared"
    if seen.identified:
        # Lengths cannot be determined from images.
        names = [name for name in seen.key_values() if not name.endswith("_mm") and name != "dictionary"]
        return _first_difference(names, seen, declared_pattern)
    return None


def _first_difference(names: Iterable[str], seen: Pattern, declared: Pattern) -> str | None:
    """Return in words the first of the keys `names` in which two patterns of one type differ; None if there is none."""
    own, other = seen.key_values(), declared.key_values()
    for name in names:
        if _differs(own[name], other[name]):
            # JSON writes these values as TOML does.
            value = json.dumps(own[name])
            return f"{name} is {json.dumps(other[name])} in the board file, {value} in the images: set {name} = {value}"
    return None


def _differs(one: object, two: object) -> bool:
    if isinstance(one, float) and isinstance(two, float):
        return bool(abs(one - two) > SAME_PRINTED_RATIO)
    return one != two


def _article(kind: str) -> str:
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"
