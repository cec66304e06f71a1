"""The place of a lattice on a ChArUco board, from the markers in its squares.

The lattice determines the squares, so that markers need no visible outlines: codes that are blurred, faint or small are
correlated with those of the board.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, known_median
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import predicted
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.tags.codes import Codes, TagCode, excess_likeness, read_tags, transferred
from rigkit.detection.tags.markers import MIN_MARKER_LIKENESS
from rigkit.detection.tags.placing import MIN_TAGS_OF_PLACE, place_together, squares_of, voted_place
from rigkit.kernels.surface import maps_of_quads

MIN_MARKERS, AGREEING_MARKERS = 3, 0.7
"""Smallest number of markers, and smallest share of those read, that agree on the place of a lattice: on a board of the
other pattern, or with other columns, only the markers of every second row agree."""

MAX_PREDICTION_GAIN = 8.0
"""Largest standard deviation of predicted corners beyond the known ones of standard deviation 1."""

ADJACENT_MARKERS = 2
"""Number of markers that touch a corner inside the board."""


def has_markers_of(boards: Sequence[Board], image: GreyImage, lattice: Lattice) -> bool:
    """Return whether the markers in a lattice's squares place it on one of these ChArUco boards.

    The blurred ink of markers disturbs the fit of the corners beside them, so that the evidence of the corners is that
    of no board: -0.2 to -4 with squares of 12 to 22 px, blurred by 1.5 and 2 px (REAL).
    """
    return any(place_by_markers(image, lattice, board) is not None for board in boards)


def place_by_markers(image: GreyImage, lattice: Lattice, board: Board) -> tuple[int, IntArray] | None:
    """Return the quarter turns and the shift (2,) from a lattice to the grid of a ChArUco board; None if its markers do
    not agree."""
    place = _place(image, lattice, board)
    if place is not None:
        return place
    # Most markers of a board of few rows are in its outer squares.
    place = _place(image, _with_outer_squares(lattice), board)
    return None if place is None else (place[0], place[1] + 1)


def _with_outer_squares(lattice: Lattice) -> Lattice:
    """Return `lattice` with a predicted corner more at both ends of each row and column."""
    wide = lattice.padded((1, 1), (1, 1))
    outside = ~wide.known
    ahead = predicted(wide.pixels, outside)
    wide.pixels[outside] = np.where(ahead.gain[:, None] < MAX_PREDICTION_GAIN, ahead.pixels, np.nan)
    wide.contrast[outside] = np.where(np.isnan(wide.pixels[outside, 0]), np.nan, known_median(lattice.contrast))
    return wide


def _place(image: GreyImage, lattice: Lattice, board: Board) -> tuple[int, IntArray] | None:
    """Return the place of a lattice, as `place_by_markers`, from the markers between its corners."""
    squares, cells = squares_of(lattice, dark=_pattern(board).inverted)
    inside = _in_image(image, squares).all(axis=1)
    squares, cells = squares[inside], cells[inside]
    if len(squares) < MIN_MARKERS:
        return None
    tags = _read(image, squares, board)
    sure = np.flatnonzero(tags.read)
    at = _places(board)[tags.number[sure] - _pattern(board).first_marker] - 1
    if len(sure) >= MIN_MARKERS:
        votes, turns, shift = voted_place(lattice, cells[sure], tags.turns[sure], at)
        if votes >= max(MIN_MARKERS, AGREEING_MARKERS * len(sure)):
            return turns, shift
    return _place_together(image, squares, cells, lattice.size, board)


def _place_together(
    image: GreyImage, squares: FloatArray, cells: IntArray, size: tuple[int, int], board: Board
) -> tuple[int, IntArray] | None:
    """Return the place of a lattice of this (columns, rows), as `place_by_markers`, from all markers in its `squares`
    (N, 4, 2) at `cells` (N, 2) together, which may be too blurred to be read one by one."""
    if len(squares) < MIN_TAGS_OF_PLACE:
        return None
    excess = excess_likeness(as_printed(image, _pattern(board)), _within(squares, board), marker_codes(board))
    codes_at, places = np.full((board.rows + 1, board.columns + 1), -1), _places(board)
    codes_at[places[:, 1], places[:, 0]] = 4 * np.arange(len(places))
    place = place_together(excess, cells, size, codes_at)
    if place is None:
        return None
    # The first square is the one before the first corner.
    return place[1], place[2] - 1


def between_markers(image: GreyImage, pixels: FloatArray, board: Board) -> FloatArray:
    """Return the approximate corners (R, C, 2) of a ChArUco board, NaN where unknown, with those added that lie between
    two markers read where the known corners predict them: what covers a corner covers one of the two."""
    places = _places(board)
    # The squares of the outermost markers extend to the ends of the board.
    grown = np.pad(pixels, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    rows, columns = places[:, 1, None] + np.array([0, 0, 1, 1]), places[:, 0, None] + np.array([0, 1, 1, 0])
    read = np.zeros(len(places), np.bool_)
    while not read.all():
        missing = np.isnan(grown[..., 0])
        beside = np.flatnonzero((~missing)[rows, columns].any(axis=1) & ~read)
        wanted = np.zeros_like(missing)
        wanted[rows[beside], columns[beside]] = True
        wanted &= missing
        guess, ahead = grown.copy(), predicted(grown, wanted)
        guess[wanted] = np.where(ahead.gain[:, None] < MAX_PREDICTION_GAIN, ahead.pixels, np.nan)
        quads = guess[rows[beside], columns[beside]]
        usable = np.isfinite(quads).all(axis=(1, 2))
        beside, quads = beside[usable], quads[usable]
        tags = _read(image, quads, board)
        own = beside[
            (tags.likeness >= MIN_MARKER_LIKENESS)
            & (tags.number == _pattern(board).first_marker + beside)
            & (tags.turns == 0)
        ]
        if not len(own):
            break
        read[own] = True
        grown[rows[own], columns[own]] = guess[rows[own], columns[own]]
    markers = np.zeros(grown.shape[:2], np.int64)
    np.add.at(markers, (rows[read], columns[read]), 1)
    grown[(markers < ADJACENT_MARKERS) & np.isnan(np.pad(pixels[..., 0], 1, constant_values=np.nan))] = np.nan
    return grown[1:-1, 1:-1]


def confirmed(image: GreyImage, pixels: FloatArray, board: Board) -> bool:
    """Return whether most markers that are read between the corners (R, C, 2) of a board, NaN where unknown, are the
    board's own in their places."""
    quads = _square_corners(pixels, _places(board))
    inside = np.flatnonzero(_in_image(image, quads).all(axis=1))
    if not len(inside):
        return False
    tags = _read(image, quads[inside], board)
    own = tags.read & (tags.number == _pattern(board).first_marker + inside) & (tags.turns == 0)
    return bool(np.count_nonzero(own) >= max(1.0, AGREEING_MARKERS * np.count_nonzero(tags.read)))


def likeness_at(image: GreyImage, pixels: FloatArray, squares: IntArray, numbers: IntArray, board: Board) -> FloatArray:
    """Return the `excess_likeness` (N,) of `squares` of a ChArUco board to the markers of these `numbers` (N,).

    Random squares have mean 0 and standard deviation 1. It is 0 if the contrast is too low, NaN if the square cannot be
    predicted from the corners, or is outside of the image.

    Parameters
    ----------
    pixels : (R, C, 2) corners, NaN where unknown.
    squares : (N, 2) column and row; (0, 0) is before the first corner, and those one beyond the board are allowed.
    """
    quads = _outlines(image, pixels, squares, board)
    inside = np.isfinite(quads).all(axis=(1, 2))
    out, codes = np.full(len(squares), np.nan), marker_codes(board)
    if inside.any():
        excess = excess_likeness(as_printed(image, _pattern(board)), quads[inside], codes)
        upright = {int(n): k for k, (n, turns) in enumerate(zip(codes.numbers, codes.turns, strict=True)) if turns == 0}
        out[inside] = excess[np.arange(len(excess)), [upright[int(n)] for n in numbers[inside]]]
    return out


def brightness_at(image: GreyImage, pixels: FloatArray, squares: IntArray, board: Board) -> FloatArray:
    """Return the brightness (N, K) of the marker modules in these squares, of inverted boards 255 minus it; NaN and
    arguments as for `likeness_at`."""
    modules = marker_codes(board).modules
    middles = (np.stack(np.meshgrid(*2 * [np.arange(modules)]), axis=-1).reshape(-1, 2) + 0.5) / modules
    return _sampled(as_printed(image, _pattern(board)), _outlines(image, pixels, squares, board), middles)


def brightness_around(
    image: GreyImage, pixels: FloatArray, squares: IntArray, at: FloatArray, board: Board
) -> FloatArray:
    """Return the brightness (N, K), as `brightness_at`, at the positions `at` (K, 2), in sides of each square from its
    first corner, which may be beyond the square; NaN outside of the image."""
    return _sampled(as_printed(image, _pattern(board)), _square_corners(pixels, squares), at)


def _sampled(image: GreyImage, quads: FloatArray, at: FloatArray) -> FloatArray:
    """Return the brightness (N, K) at the positions `at` (K, 2) in the unit squares that are imaged to `quads`
    (N, 4, 2); NaN outside of the image, and where quads are unknown."""
    out, seen = np.full((len(quads), len(at)), np.nan), np.isfinite(quads).all(axis=(1, 2))
    if seen.any():
        places = transferred(maps_of_quads(quads[seen]), at)
        out[seen] = np.where(_in_image(image, places), sample(image, places), np.nan)
    return out


def _in_image(image: GreyImage, places: FloatArray) -> BoolArray:
    return np.asarray(((places >= 0.0) & (places <= np.array(image.shape[::-1]) - 1.0)).all(axis=-1))


def marker_outlines(image: GreyImage, pixels: FloatArray, board: Board) -> FloatArray:
    """Return the outlines (M, 4, 2) of all markers of a ChArUco board; NaN and arguments as for `likeness_at`."""
    return _outlines(image, pixels, _places(board), board)


def _outlines(image: GreyImage, pixels: FloatArray, squares: IntArray, board: Board) -> FloatArray:
    """Return the outlines (N, 4, 2) of the markers in squares; NaN and arguments as for `likeness_at`."""
    quads = _square_corners(pixels, squares)
    inside = _in_image(image, quads).all(axis=1)
    out = np.full(quads.shape, np.nan)
    if inside.any():
        out[inside] = _within(quads[inside], board)
    return out


def _square_corners(pixels: FloatArray, squares: IntArray) -> FloatArray:
    """Return the corners (N, 4, 2) of squares, also of those outside of the image; NaN where they cannot be predicted;
    arguments as for `likeness_at`."""
    grown = np.pad(pixels, ((2, 2), (2, 2), (0, 0)), constant_values=np.nan)
    wanted = np.zeros(grown.shape[:2], np.bool_)
    rows, columns = (squares[:, k, None] + 1 + np.array(step) for k, step in ((1, (0, 0, 1, 1)), (0, (0, 1, 1, 0))))
    wanted[rows, columns] = True
    wanted &= np.isnan(grown[..., 0])
    ahead = predicted(grown, wanted)
    grown[wanted] = np.where(ahead.gain[:, None] < MAX_PREDICTION_GAIN, ahead.pixels, np.nan)
    return np.asarray(grown[rows, columns])


def _pattern(board: Board) -> Charuco:
    pattern = board.pattern
    assert isinstance(pattern, Charuco)
    return pattern


def _places(board: Board) -> IntArray:
    return _pattern(board).places(*board.size)


def marker_codes(board: Board) -> Codes:
    """Return the codes of the markers of a ChArUco board."""
    pattern = _pattern(board)
    numbers = pattern.first_marker + np.arange(len(_places(board)))
    return Codes.of(AprilGrid(1.0, pattern.dictionary, 1, numbering="opencv"), numbers)


def _read(image: GreyImage, squares: FloatArray, board: Board) -> TagCode:
    """Return the codes in the squares (N, 4, 2) of a board."""
    return read_tags(as_printed(image, _pattern(board)), _within(squares, board), marker_codes(board))


def as_printed(image: GreyImage, pattern: Charuco | AprilGrid) -> GreyImage:
    """Return the image with dark markers on white."""
    return 255 - image if pattern.inverted else image


def _within(squares: FloatArray, board: Board) -> FloatArray:
    """Return the outlines (N, 4, 2) of the markers in squares (N, 4, 2)."""
    margin = 0.5 * (1.0 - _pattern(board).marker_mm / np.array(board.squares_mm))
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return transferred(maps_of_quads(squares), margin + unit * (1.0 - 2.0 * margin))
