"""Unknown ChArUco boards: dictionary, size, pattern and size of the markers, from the markers read in images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.patterns.aruco import marker_count, smallest_dictionary
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.saddles.response import GreyImage, as_bytes
from rigkit.detection.tags.markers import ReadMarkers, read_markers
from rigkit.kernels.surface import maps_of_quads

DICTIONARIES = (
    *(f"DICT_{n}X{n}_1000" for n in (4, 5, 6, 7)),
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
    *(f"DICT_APRILTAG_{code}" for code in ("36h11", "36h10", "25h9", "16h5")),
)
"""The largest dictionary of each kind."""

MIN_MARKER_SIDE = 0.35
"""Smallest side of a marker, in squares."""

MIN_CODES_READ = 3
"""Smallest number of markers or tags of one family in an image whose numbers fit one board: one or two may be random
among thousands of codes."""

MIN_SHARE_FITTING = 0.5
"""Smallest share of the markers read in all images, or of the tags read in a lattice, whose numbers fit the board:
nearly all do, or few by chance."""

SURE_OF_KIND = 2
"""Number of images with markers after which only kinds seen before are read."""

DIAGONAL = 0.5
"""Smallest ratio of the distances, along rows and along columns, of two diagonally adjacent markers: it is 1, and 0 for
markers in one row or column."""

OFF_SQUARE = 0.2
"""Largest distance, in squares, of a marker's middle from that of its square as predicted by another marker."""

MAX_SQUARE_DISTANCE = 2
"""Largest distance, in squares along rows and columns, over which one marker predicts another."""

WITHIN_MARKER = 0.25
"""Two markers are at one place if their middles are closer than this, in diagonals of one: the middles of two squares
with markers are at least a diagonal of a square apart."""

Markers: TypeAlias = tuple[IntArray, IntArray, float]
"""Numbers (N,), squares (N, 2) of upright markers relative to any of them, side of a marker in squares."""


@dataclass(eq=False, slots=True)
class MarkerObservations:
    """The markers of all images, by their squares.

    Attributes
    ----------
    images : indices of those with markers in squares.
    kinds : (dictionary, inverted) -> number of markers.
    markers : the kind and the markers of each image.
    """

    images: list[int] = field(default_factory=list)
    kinds: Counter[tuple[str, bool]] = field(default_factory=Counter)
    markers: list[tuple[tuple[str, bool], Markers]] = field(default_factory=list)

    def look(self, index: int, image: GreyImage) -> bool:
        """Read the markers of an image; return whether some of them are in squares."""
        for kind, read in self._read(as_bytes(image)):
            own = _in_squares(read.corners, read.numbers)
            if own is not None:
                self.kinds[kind] += len(own[0])
                self.markers.append((kind, own))
                self.images.append(index)
                return True
        return False

    def _read(self, grey: np.ndarray[Any, np.dtype[np.uint8]]) -> list[tuple[tuple[str, bool], ReadMarkers]]:
        """Return the markers in an image by kind: kinds seen before first, then by decreasing total correlation."""
        before = [kind for kind, _ in self.kinds.most_common(2)]
        wanted = before
        if len(self.images) < SURE_OF_KIND:
            wanted = [(name, inverted) for inverted in (False, True) for name in DICTIONARIES]
        read = []
        for inverted in (False, True):
            names = [name for name, other in wanted if other == inverted]
            seen = read_markers(255 - grey if inverted else grey, names) if names else {}
            read += [((name, inverted), markers) for name, markers in _read_best(seen).items()]
        return sorted(read, key=lambda item: (item[0] not in before, -float(item[1].likeness.sum())))


def _read_best(seen: dict[str, ReadMarkers]) -> dict[str, ReadMarkers]:
    """Return the markers without those at places where another dictionary has a larger correlation: random markers of
    fewer bits are read in the modules of large markers, one or two in each, and outnumber these."""
    own = {}
    for name, markers in seen.items():
        middle, best = markers.corners.mean(axis=1), np.ones(len(markers.numbers), np.bool_)
        for other in (others for key, others in seen.items() if key != name):
            separation = np.linalg.norm(middle[:, None] - other.corners.mean(axis=1), axis=2)
            reach = WITHIN_MARKER * np.linalg.norm(other.corners[:, 2] - other.corners[:, 0], axis=1)
            best &= ~((separation < reach) & (other.likeness > markers.likeness[:, None])).any(axis=1)
        if best.any():
            own[name] = ReadMarkers(markers.corners[best], markers.numbers[best], markers.likeness[best])
    return own


def _in_squares(quads: FloatArray, numbers: IntArray) -> Markers | None:
    """Return the largest group of markers in squares that follow from each other; None if there are too few."""
    if len(numbers) < MIN_CODES_READ:
        return None
    middle = quads.mean(axis=1)
    inverse = np.linalg.inv(maps_of_quads(quads))
    seen = np.concatenate([middle, np.ones((len(middle), 1))], axis=1) @ np.swapaxes(inverse, 1, 2)
    # Positions of the others (second index) relative to each marker, in its sides from its middle.
    offset = seen[..., :2] / seen[..., 2:] - 0.5
    distance = np.linalg.norm(offset, axis=2) + np.where(np.eye(len(middle)) > 0.0, np.inf, 0.0)
    nearest = np.abs(offset[np.arange(len(middle)), distance.argmin(axis=1)])
    # The nearest marker is diagonally adjacent; in a grid of tags it is in the same row or column.
    diagonal = nearest.min(axis=1) > DIAGONAL * nearest.max(axis=1)
    if 2 * np.count_nonzero(diagonal) < len(diagonal):
        return None
    step = float(np.median(nearest[diagonal]))
    if not 1.0 < step < 1.0 / MIN_MARKER_SIDE:
        return None
    squares = np.rint(offset / step).astype(np.int64)
    near = (np.abs(offset / step - squares) < OFF_SQUARE).all(axis=2) & (
        np.abs(squares).max(axis=2) <= MAX_SQUARE_DISTANCE
    )
    # White squares touch at corners.
    near &= (squares.sum(axis=2) % 2 == 0) & (squares != 0).any(axis=2)
    near &= near.T
    own, places = max(laid_out(near, squares), key=lambda group: len(group[0]))
    return None if len(own) < MIN_CODES_READ else (numbers[own], places, 1.0 / step)


def laid_out(near: BoolArray, steps: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the groups of N things that are linked by `near` (N, N): their indices (M,), and their places (M, 2)
    relative to the first, as sums of the `steps` (N, N, 2) between them."""
    left = set(range(len(near)))
    while left:
        first = left.pop()
        places, due = {first: np.zeros(2, np.int64)}, [first]
        while due:
            k = due.pop()
            for other in np.flatnonzero(near[k]).tolist():
                if other not in places:
                    places[other] = places[k] + steps[k, other]
                    due.append(other)
        left -= set(places)
        yield np.array(list(places)), np.array(list(places.values()))


def guessed_charuco(seen: MarkerObservations, exactly: int | None = None) -> list[Board]:
    """Return the ChArUco board of most markers, with squares of 1 mm: both patterns if the markers fit both, none if
    the markers determine no board. It has `exactly` rows if given, else those that were read."""
    if not seen.markers:
        return []
    (dictionary, inverted), _ = seen.kinds.most_common(1)[0]
    own = [markers for kind, markers in seen.markers if kind == (dictionary, inverted)]
    two_rows: Counter[int] = Counter()
    for numbers, places, _ in own:
        at = {tuple(place): int(number) for place, number in zip(places.tolist(), numbers, strict=True)}
        two_rows.update(at[c, r + 2] - number for (c, r), number in at.items() if (c, r + 2) in at)
    # Two rows of squares have as many white ones as a row has squares.
    columns = two_rows.most_common(1)[0][0] - 1 if two_rows else 0
    if columns < 2:
        return []
    count = sum(len(numbers) for numbers, *_ in own)
    # Two markers alone agree with any number of columns that follows from them.
    own = [read for markers in own if len((read := _in_order(*markers, columns))[0]) >= MIN_CODES_READ]
    if not own:
        return []
    first = _first_marker(own)
    last = max(int(numbers.max()) for numbers, *_ in own)
    side = round(float(np.median([side for _, _, side in own])), 2)
    tall = {int(np.ptp(places[:, 1])) for _, places, _ in own}
    tall = {*tall, round(2.0 * (last + 1 - first) / (columns + 1)) - 1} if exactly is None else {exactly}
    found: list[tuple[tuple[int, int], Board]] = []
    for legacy in (False, True):
        for rows in sorted(tall):
            if rows < 2:
                continue
            least = smallest_dictionary(dictionary, first + ((columns + 1) * (rows + 1) + 1) // 2)
            pattern = Charuco(least, side, first, legacy, inverted)
            board = Board("board", columns, rows, 1.0, 1.0, pattern=pattern)
            if first + len(pattern.places(*board.size)) > marker_count(pattern.dictionary):
                continue
            fitting = sum(_fitting(pattern, board, numbers, places) for numbers, places, _ in own)
            # Of boards that fit as many markers the smallest is chosen.
            found.append(((fitting, -rows), board))
    most = max((rank for rank, _ in found), default=(0, 0))
    # Random markers fit no board.
    return [board for rank, board in found if rank == most and rank[0] >= MIN_SHARE_FITTING * count]


def _in_order(numbers: IntArray, places: IntArray, side: float, columns: int) -> Markers:
    """Return the markers of an image without misread ones, whose numbers contradict their squares on a board with this
    many columns of corners."""
    # Every second square has a marker, so that numbers are predicted to half a marker.
    first = numbers - 0.5 * ((columns + 1) * places[:, 1] + places[:, 0])
    kept = np.abs(first - np.median(first)) <= 1.0
    return numbers[kept], places[kept], side


def _fitting(pattern: Charuco, board: Board, numbers: IntArray, places: IntArray) -> int:
    """Return the number of markers of an image that agree with the board after one common shift."""
    table = {pattern.first_marker + k: place for k, place in enumerate(pattern.places(*board.size))}
    shifts = Counter(
        tuple((table[int(n)] - 1 - p).tolist()) for n, p in zip(numbers, places, strict=True) if int(n) in table
    )
    return max(shifts.values(), default=0)


def _first_marker(own: list[Markers]) -> int:
    """Return the number of the board's first marker: the smallest number seen, or 0 as on OpenCV's boards."""
    least = int(min(numbers.min() for numbers, *_ in own))
    most = int(max(numbers.max() for numbers, *_ in own))
    # If the range of numbers exceeds the smallest one, unseen first rows are more likely than an unusual first number.
    return 0 if least < most - least else least
