"""ChArUco boards that nobody has described: dictionary, counts, pattern and size of markers from what is read."""

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
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.markers import ReadMarkers, read_markers
from rigkit.kernels.surface import maps_of_quads

DICTIONARIES = (
    *(f"DICT_{n}X{n}_1000" for n in (4, 5, 6, 7)),
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
    *(f"DICT_APRILTAG_{code}" for code in ("36h11", "36h10", "25h9", "16h5")),
)
"""The largest of each kind."""

MIN_MARKER_SIDE = 0.35
"""Of a marker, in squares."""

MIN_MARKERS_READ = 3
"""Markers of one dictionary in an image whose numbers fit one board: one or two may be chance."""

MIN_SHARE_FITTING = 0.5
"""Of the markers read in all images, those that lie where the board has them: nearly all, or few by chance."""

SURE_OF_KIND = 2
"""Images with markers after which only kinds seen before are looked for."""

OFF_SQUARE = 0.2
"""A marker's middle lies within so many squares of that of its square, as another marker beside it has it."""

MAX_SQUARE_DISTANCE = 2
"""Squares, along rows and columns, over which one marker says where another is."""

WITHIN_MARKER = 0.25
"""A marker lies where another is read whose middle is this near, in diagonals of that one: the middles of two squares
with markers are at least a diagonal of a square apart."""

Markers: TypeAlias = tuple[IntArray, IntArray, float]
"""Numbers (N,), squares (N, 2) upright from any origin, side of a marker in squares."""


@dataclass(eq=False, slots=True)
class MarkerObservations:
    """The markers of all images, by the squares they lie in.

    Attributes
    ----------
    images : indices of those that show markers in squares.
    kinds : (dictionary, inverted) -> markers.
    markers : with the kind, of each image.
    """

    images: list[int] = field(default_factory=list)
    kinds: Counter[tuple[str, bool]] = field(default_factory=Counter)
    markers: list[tuple[tuple[str, bool], Markers]] = field(default_factory=list)

    def look(self, index: int, image: GreyImage) -> bool:
        """Read the markers of an image; say whether some lie in squares."""
        for kind, read in self._read(np.clip(np.rint(image), 0, 255).astype(np.uint8)):
            own = _in_squares(read.corners, read.numbers)
            if own is not None:
                self.kinds[kind] += len(own[0])
                self.markers.append((kind, own))
                self.images.append(index)
                return True
        return False

    def _read(self, grey: np.ndarray[Any, np.dtype[np.uint8]]) -> list[tuple[tuple[str, bool], ReadMarkers]]:
        """Return the kinds of markers that an image shows: those seen before, then those that more is like."""
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
    """Return the markers without those that another dictionary reads better where they are: in the modules of a large
    marker chance reads others of fewer bits, one or two of them in each, so that there are more of them."""
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
    """Return the largest group of markers whose places in squares follow from each other; None for too few."""
    if len(numbers) < MIN_MARKERS_READ:
        return None
    middle = quads.mean(axis=1)
    inverse = np.linalg.inv(maps_of_quads(quads))
    seen = np.concatenate([middle, np.ones((len(middle), 1))], axis=1) @ np.swapaxes(inverse, 1, 2)
    # Where each marker (first index) has the others, in its own sides from its own middle.
    offset = seen[..., :2] / seen[..., 2:] - 0.5
    distance = np.linalg.norm(offset, axis=2) + np.where(np.eye(len(middle)) > 0.0, np.inf, 0.0)
    nearest = offset[np.arange(len(middle)), distance.argmin(axis=1)]
    # The nearest ones lie beyond a corner of the square.
    step = float(np.median(np.abs(nearest)))
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
    return None if len(own) < MIN_MARKERS_READ else (numbers[own], places, 1.0 / step)


def laid_out(near: BoolArray, steps: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the groups of N things of which each is `near` (N, N) another one: which (M,), and their places (M, 2) from
    the first, as the `steps` (N, N, 2) from one to the other add up."""
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
    """Return the ChArUco board that most markers are of, with squares of 1 mm: one of either pattern where the markers
    fit both, none where no board is told. It has `exactly` so many rows, or those that were read."""
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
    # From two markers alone a number of columns follows that puts both in order.
    own = [read for markers in own if len((read := _in_order(*markers, columns))[0]) >= MIN_MARKERS_READ]
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
            # Of boards that explain as many markers the smallest.
            found.append(((fitting, -rows), board))
    most = max((rank for rank, _ in found), default=(0, 0))
    # What chance reads fits no board.
    return [board for rank, board in found if rank == most and rank[0] >= MIN_SHARE_FITTING * count]


def _in_order(numbers: IntArray, places: IntArray, side: float, columns: int) -> Markers:
    """Return the markers of an image without those whose numbers are not what their squares make them on a board of so
    many columns of corners: misread ones."""
    # Every second square has a marker, so that numbers are known to half a marker.
    first = numbers - 0.5 * ((columns + 1) * places[:, 1] + places[:, 0])
    kept = np.abs(first - np.median(first)) <= 1.0
    return numbers[kept], places[kept], side


def _fitting(pattern: Charuco, board: Board, numbers: IntArray, places: IntArray) -> int:
    """Return how many markers of an image lie where the board has them, moved by one shift."""
    table = {pattern.first_marker + k: place for k, place in enumerate(pattern.places(*board.size))}
    shifts = Counter(
        tuple((table[int(n)] - 1 - p).tolist()) for n, p in zip(numbers, places, strict=True) if int(n) in table
    )
    return max(shifts.values(), default=0)


def _first_marker(own: list[Markers]) -> int:
    """Return the smallest number seen; OpenCV's own boards begin with 0."""
    least = int(min(numbers.min() for numbers, *_ in own))
    most = int(max(numbers.max() for numbers, *_ in own))
    # Where the first rows were never seen, numbers from 0 on are likelier than a board that begins with an odd one.
    return 0 if least < most - least else least
