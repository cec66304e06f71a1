"""Chessboards as a person measured them, and where their corners lie; ChArUco boards have markers in their squares."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.core.errors import InputError
from rigkit.core.identifiers import check_identifier

__all__ = ["Board", "Markers", "marker_rectangles"]


@dataclass(frozen=True, slots=True)
class Markers:
    """The ArUco markers in the white squares of a ChArUco board, numbered row by row.

    Attributes
    ----------
    dictionary : name in OpenCV, such as "DICT_5X5_100".
    side_mm : side of a marker with its black border.
    first_id : number of the first marker; boards in one image need different ones, or different dictionaries.
    legacy_pattern : as OpenCV drew boards before 4.6: with an even number of rows of squares the first one is white.
    """

    dictionary: str
    side_mm: float
    first_id: int = 0
    legacy_pattern: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class Board:
    """A chessboard of `columns` x `rows` INNER corners.

    Frame: origin at the first inner corner, x along the columns, y along the rows, z into the board (so a camera that
    looks at the board's face sees x, y, z right-handed like its own axes).

    Attributes
    ----------
    board_id : name in manifests, clouds and tables.
    columns, rows : inner corners along x and y.
    square_x_mm, square_y_mm : measured side of a square.
    square_sigma_mm : standard deviation of that measurement, if stated.
    markers : of a ChArUco board; None for a chessboard, and for a ChArUco board that is to be read as a chessboard.

    >>> Board("a", 8, 6, 50.0, 50.0).looks_same_turned
    True
    >>> Board("a", 9, 6, 30.0, 30.0).corner_count
    54
    """

    board_id: str
    columns: int
    rows: int
    square_x_mm: float
    square_y_mm: float
    _: KW_ONLY
    square_sigma_mm: float | None = None
    markers: Markers | None = None

    def __post_init__(self) -> None:
        check_identifier(self.board_id, "board")
        if not all(isinstance(count, int | np.integer) for count in (self.columns, self.rows)):
            raise InputError(
                f"board '{self.board_id}': columns and rows are whole numbers, got {self.columns!r} and {self.rows!r}"
            )
        if self.columns < 2 or self.rows < 2:
            raise InputError(f"board '{self.board_id}': at least 2x2 inner corners, got {self.columns}x{self.rows}")
        for side in (self.square_x_mm, self.square_y_mm):
            if not (np.isfinite(side) and side > 0.0):
                raise InputError(f"board '{self.board_id}': the square size must be positive, got {side} mm")
        sigma = self.square_sigma_mm
        if sigma is not None and not (np.isfinite(sigma) and sigma >= 0.0):
            raise InputError(f"board '{self.board_id}': square_sigma_mm cannot be {sigma}")
        if self.markers is not None and not 0.0 < self.markers.side_mm < min(self.square_x_mm, self.square_y_mm):
            raise InputError(
                f"board '{self.board_id}': markers of {self.markers.side_mm} mm do not fit into its squares; "
                "give the side of a marker with its black border"
            )

    @property
    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        return (self.columns, self.rows)

    @property
    def corner_count(self) -> int:
        return self.columns * self.rows

    @property
    def looks_same_turned(self) -> bool:
        """Whether the board looks the same turned by 180 degrees: then no single image can tell its first corner."""
        return self.markers is None and (self.columns + self.rows) % 2 == 0

    @property
    def first_black(self) -> bool:
        """Whether the square before the first inner corner is black, as far as a rule says so: on ChArUco boards."""
        return self.markers is None or not self.markers.legacy_pattern or self.rows % 2 == 0

    def grid(self) -> IntArray:
        """Return (column, row) of all corners, (columns * rows, 2), row by row."""
        row, column = np.divmod(np.arange(self.corner_count), self.columns)
        return np.stack([column, row], axis=-1)

    def points(self, grid: IntArray | None = None) -> Points:
        """Return the corners `grid` (N, 2; all by default) in the board frame, (N, 3) mm."""
        chosen = self.grid() if grid is None else np.asarray(grid)
        scale = np.array([self.square_x_mm, self.square_y_mm])
        return np.concatenate([chosen * scale, np.zeros((len(chosen), 1))], axis=1)


def marker_rectangles(board: Board, *, upright: bool = False) -> FloatArray:
    """Return the black parts of all markers of a ChArUco board as rectangles (M, 4): x, y, width, height.

    In squares, in the board frame (origin at the first inner corner). Touching modules of a row are one rectangle, or
    those of a column (`upright`): either way all that is black is covered once.

    Raises InputError where the dictionary is unknown or has too few markers for the board.
    """
    markers = board.markers
    if markers is None:
        return np.zeros((0, 4))
    import cv2

    known = getattr(cv2.aruco, markers.dictionary, None)
    if known is None or not markers.dictionary.startswith("DICT_"):
        raise InputError(
            f"board '{board.board_id}': dictionary '{markers.dictionary}' is unknown; give a name of OpenCV's such as "
            "DICT_4X4_50, DICT_5X5_100 or DICT_APRILTAG_36h11"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(known)
    row, column = np.mgrid[: board.rows + 1, : board.columns + 1]
    white = np.argwhere((row + column) % 2 == int(board.first_black))
    available = dictionary.bytesList.shape[0]
    if markers.first_id < 0 or markers.first_id + len(white) > available:
        raise InputError(
            f"board '{board.board_id}': markers {markers.first_id} to {markers.first_id + len(white) - 1} are needed, "
            f"{markers.dictionary} has 0 to {available - 1}; take a larger dictionary"
        )
    modules = int(dictionary.markerSize) + 2
    side = markers.side_mm / np.array([board.square_x_mm, board.square_y_mm])
    out = []
    for marker, (j, i) in enumerate(white, markers.first_id):
        black = cv2.aruco.generateImageMarker(dictionary, marker, modules, borderBits=1) == 0
        change = np.diff(np.pad(black.T if upright else black, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        (line, start), (_, end) = np.nonzero(change == 1), np.nonzero(change == -1)
        place, extent = np.stack([start, line], axis=-1), np.stack([end - start, np.ones_like(line)], axis=-1)
        if upright:
            place, extent = place[:, ::-1], extent[:, ::-1]
        corner = np.array([i, j]) - 1.0 + 0.5 * (1.0 - side)
        out.append(np.concatenate([corner + place * side / modules, extent * side / modules], axis=1))
    return np.concatenate(out)
