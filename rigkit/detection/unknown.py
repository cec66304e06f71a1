"""What board images show, when nobody has said it: everything but the scale."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.circles import Circles
from rigkit.core.processes import in_threads
from rigkit.core.progress import Progress, silent
from rigkit.detection.circles.unknown import CircleSightings, guessed_circles
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.tags.unknown_charuco import MarkerSightings, guessed_charuco
from rigkit.detection.tags.unknown_tags import ARUCO_TAGS, TagSightings, guessed_grids

MIN_IMAGES_OF_GUESS = 2
"""A size of chessboards is told from so many images, or from the only one."""

LOOKING = "looking which board it is"
"""What progress is told of."""

IMAGES_OF_PATTERN = 4
"""Images whose corners tell which of two patterns a board has, where its markers do not."""

MIN_SURE_CORNERS = 20
"""Lattices of as many corners are no chance."""

WITHIN_SQUARES = np.linspace(0.2, 0.8, 9)
"""Where in a square its levels are looked at, along either side."""

MAX_LEVELS_APART = 0.35
"""Levels within an empty square differ by less, of black to white: shade and noise; a marker's by all of it, or by half
where it is blurred."""


@dataclass(frozen=True, eq=False, slots=True)
class BoardGuess:
    """A board that images show.

    Attributes
    ----------
    board : with squares, or tags, of 1 mm.
    images : indices of the images that show it.
    beside : other boards that images show.
    """

    board: Board
    images: tuple[int, ...]
    beside: tuple[Board, ...] = ()


def guess_board(images: Sequence[GreyImage], progress: Progress = silent) -> BoardGuess | None:
    """Return the board that most of the images (grey levels 0..255) show; None where none is seen.

    Boards with marks are told by these: AprilGrids, ChArUco boards (also of the pattern before OpenCV 4.6, and
    inverted). Otherwise it is the largest chessboard that is seen often, or a grid of circles that more images show.
    `progress` is told after every image.
    """
    tags, markers = TagSightings(), MarkerSightings()
    plain: list[list[BoardDetection]] = []
    for found in in_threads(detect_boards, images):
        progress(LOOKING, len(plain), len(images))
        plain.append([d for d in found if d.complete])
    sure = [
        k
        for k, (image, found) in enumerate(zip(images, plain, strict=True))
        if any(_without_marks(image, one) for one in found)
    ]
    for k in (k for k in range(len(images)) if k not in sure):
        if not tags.look(k, images[k]):
            markers.look(k, images[k])
    # A tiled floor is a chessboard without marks in every image, but hardly of one size in most.
    if tags.images or markers.images or not _in_most(plain):
        for k in sure:
            if not tags.look(k, images[k]):
                markers.look(k, images[k])
    guess = _guess_of(images, plain, tags, markers)
    progress(LOOKING, len(images), len(images))
    return guess


def _guess_of(
    images: Sequence[GreyImage],
    plain: Sequence[Sequence[BoardDetection]],
    tags: TagSightings,
    markers: MarkerSightings,
) -> BoardGuess | None:
    grids = guessed_grids(tags)
    if grids:
        return BoardGuess(*grids[0], tuple(board for board, _ in grids[1:]))
    charuco = guessed_charuco(markers)
    if charuco:
        return BoardGuess(_of_pattern(charuco, [images[k] for k in markers.images]), tuple(markers.images))
    guess = _plain_guess(images, plain)
    if guess is not None:
        return guess
    # Last, as the markers of ChArUco boards stand in rows, too.
    aruco = TagSightings(ARUCO_TAGS)
    for k, image in enumerate(images):
        aruco.look_alone(k, image)
    grids = guessed_grids(aruco)
    return BoardGuess(*grids[0], tuple(board for board, _ in grids[1:])) if grids else None


def _of_pattern(boards: Sequence[Board], images: Sequence[GreyImage]) -> Board:
    """Return the board of which the images show most corners, of the pattern of today or the one before it. Where a row
    has an odd number of squares, the two are numbered alike but for one column, whose markers the images may not show:
    with the wrong one the corners beside that column have no place on the board."""
    if len(boards) == 1:
        return boards[0]
    some = images[:: -(-len(images) // IMAGES_OF_PATTERN)]
    seen = in_threads(
        lambda image: [sum(len(d.grid) for d in detect_boards(image, [b]) if d.board_id) for b in boards], some
    )
    return boards[int(np.sum(list(seen), axis=0).argmax())]


def _without_marks(image: GreyImage, found: BoardDetection) -> bool:
    """Say whether a lattice is a chessboard beyond doubt: large, and with nothing in its squares."""
    if len(found.grid) < MIN_SURE_CORNERS:
        return False
    pixels = found.pixels.reshape(found.rows, found.columns, 2)
    v, u = WITHIN_SQUARES[:, None, None, None, None], WITHIN_SQUARES[None, :, None, None, None]
    top = (1.0 - u) * pixels[:-1, :-1] + u * pixels[:-1, 1:]
    bottom = (1.0 - u) * pixels[1:, :-1] + u * pixels[1:, 1:]
    levels = sample(image, ((1.0 - v) * top + v * bottom).reshape(-1, 2)).reshape(len(WITHIN_SQUARES) ** 2, -1)
    row, column = np.indices((found.rows - 1, found.columns - 1))
    odd = ((row + column) % 2).ravel() == 1
    contrast = abs(float(levels[:, odd].mean() - levels[:, ~odd].mean()))
    return all(float(np.median(np.ptp(levels[:, of], axis=0))) < MAX_LEVELS_APART * contrast for of in (odd, ~odd))


def _sizes(found: Sequence[BoardDetection]) -> set[tuple[int, int]]:
    """Return the sizes of an image's grids, the longer side first."""
    return {(max(d.columns, d.rows), min(d.columns, d.rows)) for d in found}


def _in_most(plain: Sequence[Sequence[BoardDetection]]) -> bool:
    """Say whether at least half of the images, and more than one, show grids of one size."""
    counts = Counter(size for found in plain for size in _sizes(found))
    return max(counts.values(), default=0) >= max(0.5 * len(plain), MIN_IMAGES_OF_GUESS)


def _plain_guess(images: Sequence[GreyImage], plain: Sequence[Sequence[BoardDetection]]) -> BoardGuess | None:
    """Return the chessboard, or grid of circles, that most of the images show; None where none is seen."""
    circles, settled = CircleSightings(), _in_most(plain)
    for k, (image, found) in enumerate(zip(images, plain, strict=True)):
        if not (found and settled):
            circles.look(k, image)
    # A part of a board that the frame cuts, or a tiled floor, comes in many sizes; the whole board in one.
    counts = Counter(size for found in plain for size in _sizes(found))
    often = [size for size, n in counts.items() if n >= min(MIN_IMAGES_OF_GUESS, max(counts.values()))]
    best = max(often, key=lambda size: (counts[size], size[0] * size[1]), default=None)
    grid = guessed_circles(circles)
    if grid is not None and (best is None or len(grid[1]) > counts[best]):
        return BoardGuess(*grid)
    if best is None:
        return None
    shown = tuple(k for k, found in enumerate(plain) if best in _sizes(found))
    return BoardGuess(Board("board", *best, 1.0, 1.0), shown)


def difference(guess: Board, declared: Board) -> str | None:
    """Return in words what is to be changed in a declared board so that it is the one seen; None for nothing."""
    seen, said = guess.pattern, declared.pattern
    size = f"{guess.columns // seen.points_per_count} x {guess.rows // seen.points_per_count} {seen.count_word}"
    if type(seen) is not type(said):
        word = "" if seen.type.endswith("board") else " board"
        return f'{_article(seen.type)}{word} of {size} is seen; set type = "{seen.type}"'
    if isinstance(seen, Charuco) and isinstance(said, Charuco):
        if seen.legacy != said.legacy and guess.rows % 2 == 1:
            words = "this is the legacy pattern" if seen.legacy else "this is not the legacy pattern"
            return f"{words}: set legacy_pattern = {str(seen.legacy).lower()}"
        if seen.inverted != said.inverted:
            negation = "" if seen.inverted else "not "
            return f"black and white are {negation}exchanged: set inverted = {str(seen.inverted).lower()}"
        if seen.dictionary.rpartition("_")[0] != said.dictionary.rpartition("_")[0]:
            return f'the markers are of {seen.dictionary}: set dictionary = "{seen.dictionary}"'
    if isinstance(seen, Circles) and isinstance(said, Circles):
        for name in ("layout", "inverted"):
            if getattr(seen, name) != getattr(said, name):
                shown, told = (str(getattr(pattern, name)).lower() for pattern in (seen, said))
                return f"{name} is {told} in the board file, {shown} in the images"
    if set(guess.size) != set(declared.size) or (seen.identified and guess.size != declared.size):
        per = said.points_per_count
        return f"{size} are seen, {declared.columns // per} x {declared.rows // per} are declared"
    if seen.identified:
        # Lengths are for a ruler to say.
        own, other = seen.key_values(), said.key_values()
        for name in own:
            if not name.endswith("_mm") and name != "dictionary" and _differs(own[name], other[name]):
                return f"{name} is {other[name]} in the board file, {own[name]} in the images"
    return None


def _differs(one: object, two: object) -> bool:
    if isinstance(one, float) and isinstance(two, float):
        return bool(abs(one - two) > SAME_PRINTED_RATIO)
    return one != two


def _article(kind: str) -> str:
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"


SAME_PRINTED_RATIO = 0.05
"""Ratios read from images differ from those of the print by less."""
