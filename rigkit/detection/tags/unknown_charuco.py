"""ChArUco boards that nobody has described: dictionary, counts, pattern and size of markers from what is read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import cv2
import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.patterns.aruco import SIZES, marker_count, smallest_dictionary
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.codes import homographies

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

SURE_OF_KIND = 2
"""Images with markers after which only kinds seen before are looked for."""

OFF_SQUARE = 0.2
"""A marker's middle lies within so many squares of that of its square, as another marker beside it has it."""

MAX_SQUARES_APART = 2
"""Squares, along rows and columns, over which one marker says where another is."""

Markers: TypeAlias = tuple[IntArray, IntArray, float]
"""Numbers (N,), squares (N, 2) upright from any origin, side of a marker in squares."""


@dataclass(eq=False, slots=True)
class MarkerSightings:
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

    def look(self, index: int, image: GreyImage, *, every: bool = True) -> bool:
        """Read the markers of an image, or only the first ones of each dictionary; say whether some lie in squares."""
        grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        both = {False: grey, True: 255 - grey}
        for kind, dictionary in self._tries(every):
            own = _in_squares(*_markers(both[kind[1]], dictionary))
            if own is not None and dictionary != kind[0]:
                own = _in_squares(*_markers(both[kind[1]], kind[0]))
            if own is not None:
                self.kinds[kind] += len(own[0])
                self.markers.append((kind, own))
                self.images.append(index)
                return True
        return False

    def _tries(self, every: bool) -> Iterator[tuple[tuple[str, bool], str]]:
        """Yield the kinds and what is read of them: what was seen before is tried first; then, as the time goes by the
        number of markers and most boards begin with marker 0, the first ones of every kind, then all."""
        before = [kind for kind, _ in self.kinds.most_common(2)]
        yield from ((kind, kind[0]) for kind in before)
        if len(self.images) >= SURE_OF_KIND:
            return
        kinds = [(name, inverted) for inverted in (False, True) for name in DICTIONARIES]
        yield from ((kind, _beginning(kind[0])) for kind in kinds)
        if every:
            yield from ((kind, kind[0]) for kind in kinds if kind not in before and _beginning(kind[0]) != kind[0])


def _beginning(dictionary: str) -> str:
    """Return the dictionary of a kind's first markers, where OpenCV has one."""
    kind, _, count = dictionary.rpartition("_")
    return f"{kind}_{SIZES[0]}" if count == str(SIZES[-1]) else dictionary


def _markers(grey: np.ndarray[Any, np.dtype[np.uint8]], dictionary: str) -> tuple[FloatArray, IntArray]:
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners, numbers, _ = cv2.aruco.ArucoDetector(known).detectMarkers(grey)
    if numbers is None or not len(numbers):
        return np.zeros((0, 4, 2)), np.zeros(0, np.int64)
    return np.array(corners, dtype=np.float64).reshape(-1, 4, 2), np.asarray(numbers, dtype=np.int64).ravel()


def _in_squares(quads: FloatArray, numbers: IntArray) -> Markers | None:
    """Return the largest group of markers whose places in squares follow from each other; None for too few."""
    if len(numbers) < MIN_MARKERS_READ:
        return None
    middle = quads.mean(axis=1)
    inverse = np.linalg.inv(homographies(quads))
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
        np.abs(squares).max(axis=2) <= MAX_SQUARES_APART
    )
    # White squares touch at corners.
    near &= (squares.sum(axis=2) % 2 == 0) & (squares != 0).any(axis=2)
    near &= near.T
    best: dict[int, tuple[int, int]] = {}
    left = set(range(len(numbers)))
    while left:
        first = left.pop()
        place, due = {first: (0, 0)}, [first]
        while due:
            k = due.pop()
            for other in np.flatnonzero(near[k]).tolist():
                if other not in place:
                    place[other] = (place[k][0] + int(squares[k, other, 0]), place[k][1] + int(squares[k, other, 1]))
                    due.append(other)
        left -= set(place)
        best = place if len(place) > len(best) else best
    if len(best) < MIN_MARKERS_READ:
        return None
    own = np.array(list(best))
    return numbers[own], np.array([best[k] for k in own.tolist()]), 1.0 / step


def guessed_charuco(seen: MarkerSightings) -> Board | None:
    """Return the ChArUco board that most markers are of, with squares of 1 mm; None where none is told."""
    if not seen.markers:
        return None
    (dictionary, inverted), _ = seen.kinds.most_common(1)[0]
    own = [markers for kind, markers in seen.markers if kind == (dictionary, inverted)]
    two_rows: Counter[int] = Counter()
    for numbers, places, _ in own:
        at = {tuple(place): int(number) for place, number in zip(places.tolist(), numbers, strict=True)}
        two_rows.update(at[c, r + 2] - number for (c, r), number in at.items() if (c, r + 2) in at)
    # Two rows of squares have as many white ones as a row has squares.
    columns = two_rows.most_common(1)[0][0] - 1 if two_rows else 0
    if columns < 2:
        return None
    first = _first_marker(own)
    last = max(int(numbers.max()) for numbers, *_ in own)
    side = round(float(np.median([side for _, _, side in own])), 2)
    tall = Counter(int(np.ptp(places[:, 1])) for _, places, _ in own)
    best: tuple[int, int, Board] | None = None
    for legacy in (False, True):
        for rows in sorted({*tall, 2 * (last + 1 - first) // (columns + 1)}):
            if rows < 2:
                continue
            least = smallest_dictionary(dictionary, first + ((columns + 1) * (rows + 1) + 1) // 2)
            pattern = Charuco(least, side, first, legacy, inverted)
            board = Board("board", columns, rows, 1.0, 1.0, pattern=pattern)
            if first + len(pattern.places(*board.size)) > marker_count(pattern.dictionary):
                continue
            fitting = sum(_fitting(pattern, board, numbers, places) for numbers, places, _ in own)
            # Of boards that explain as many markers the smallest, of its patterns the new one.
            if best is None or (fitting, -rows) > best[:2]:
                best = fitting, -rows, board
    return None if best is None else best[2]


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
