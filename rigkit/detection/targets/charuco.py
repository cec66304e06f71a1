"""ChArUco boards: the corners of our own detector, with their places in the board from its markers.

The markers in the squares of a lattice say where in the board it lies (turn and shift by vote, so that a misread marker
does nothing). Where they do not, OpenCV finds markers by their outlines: the corners beside them name lattices, fill in
what these have missed, and stand in for them. Where the corners are exactly, the edge model says, as for any board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, known_median
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.checks.validate import has_edge_offset
from rigkit.detection.guided.corner_fit import MARKER_BLURS, RADIUS_PX, fit_corners, gap_to_markers
from rigkit.detection.guided.guided import MAX_ADDED_RESIDUAL_MARKED, completed
from rigkit.detection.guided.relit import relit
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.saddles.response import GreyImage, pyramid
from rigkit.detection.subpixel.correlation import shared_noise, with_uneven
from rigkit.detection.subpixel.edge_curvature import line_curvatures_to_fit
from rigkit.detection.subpixel.edge_model import NEAR_PX, NEAR_SIGMAS
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import scatter_factors
from rigkit.detection.subpixel.subpixel import refine
from rigkit.detection.subpixel.whole_board import placed_together
from rigkit.detection.tags.codes import transferred
from rigkit.detection.tags.in_squares import between_markers, place_by_markers
from rigkit.detection.tags.without_markers import without_markers
from rigkit.detection.targets.base import Finder, Search
from rigkit.kernels.boards import Picture
from rigkit.kernels.surface import maps_of_quads

SAME_CELLS = 0.2
"""A marker's corner and a corner of a lattice are one within so many sides of a cell."""

MIN_VOTES, AGREEING_VOTES = 3, 0.7
"""Corners, and which part of them, that must give a lattice the same place in the board."""

MASKING_ROUNDS = 2
"""Times that markers are wiped out and corners fitted anew: the second time from corners without their ink."""

MOVED_PX, MIN_MOVED, MIN_DRAWN = 0.05, 12, -0.5
"""By how much markers are wiped out beside their places, corner by corner this way or that, to see how corners follow;
coordinates that say it at least; and the least that is believed: sigmas are doubled then."""

SEED_CONTRAST = 100.0
"""Contrast that a corner starts with, grey levels: the fit measures it."""


class CharucoFinder(Finder):
    """Lattices that markers name; they are no chessboards for anybody else."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        lattices = search.lattices
        found, rest = _charuco_boards(search, lattices, boards)
        finest = pyramid(search.grey)[0] if rest else None
        search.leave([item for item in rest if finest and not has_edge_offset(item.lattice, finest)])
        every = [completed(item.picture, _detection(item), [item.shown], search.camera) for item in found]
        if search.quick:
            return every
        pairs = zip(every, found, strict=True)
        return [relit(search.grey, detection, item.refined, item.board) for detection, item in pairs]


def _too_unlike(fitted: RefinedLattice, sure: BoolArray) -> BoolArray:
    """Return which corners (R, C), but for those that are `sure`, leave too much for corners beside them."""
    left = fitted.relative_residual
    with np.errstate(invalid="ignore"):
        return np.asarray(~sure & (left > MAX_ADDED_RESIDUAL_MARKED * known_median(left[sure])))


def _with_more(refined: RefinedLattice, detection: BoardDetection, board: Board) -> RefinedLattice:
    """Return `refined` with the corners of a detection on its grid that it has not; itself where there are none."""
    more = _of(board, detection.grid, detection.pixels)
    sigma = np.full(refined.sigma_px.shape, np.nan)
    sigma[detection.grid[:, 1], detection.grid[:, 0]] = detection.sigma_px
    if not (more.known & ~refined.lattice.known).any():
        return refined
    typical = np.full(sigma.shape, known_median(refined.blur_px))
    return refined.filled(replace(refined, lattice=more, sigma_px=sigma, blur_px=typical))


@dataclass(frozen=True, eq=False, slots=True)
class _MarkedBoard:
    """A board's corners on its grid, the picture that they were placed in last, and what that shows: without its
    markers, if these are taken away, the squares of the `board` alone."""

    refined: RefinedLattice
    board: Board
    picture: GreyImage
    shown: Board


def _charuco_boards(
    search: Search, found: Sequence[RefinedLattice], boards: Sequence[Board]
) -> tuple[list[_MarkedBoard], list[RefinedLattice]]:
    """Return the ChArUco boards in an image on their own grids, and the lattices that are none.

    Parameters
    ----------
    search : the image.
    found : all lattices of the image.
    boards : the ChArUco boards that may be there.
    """
    image, rest = search.grey, list(found)
    pictures = [image] if search.stored is image else [image, search.stored]
    out = []
    for board in boards:
        whole, left = _by_squares(image, rest, board)
        if not whole.count:
            whole, left = _by_outlines(pictures, rest, board)
        if not whole.count:
            continue
        placed = _beside_markers(image, refine(image, [whole])[0], board, search.camera)
        if placed.refined.lattice.count >= search.min_corners:
            out.append(placed)
            rest = left
    return out, rest


def _by_squares(
    image: GreyImage, lattices: Sequence[RefinedLattice], board: Board
) -> tuple[Lattice, list[RefinedLattice]]:
    """Return the corners of a board that the markers in squares of lattices name, and the lattices that have none."""
    whole, left = _empty(board), []
    for item in sorted(lattices, key=lambda item: -item.lattice.count):
        place = place_by_markers(image, item.lattice, board)
        part = _empty(board) if place is None else _onto(item.lattice.turned(place[0]), place[1], board)
        # Two parts of one board share no place: what lies where another does is a board alike.
        if not part.count or (part.known & whole.known).any():
            left.append(item)
        else:
            whole = whole.filled(part)
    if not whole.count:
        return whole, left
    pixels = between_markers(image, whole.pixels, board)
    seeds = np.where(np.isfinite(pixels[..., 0]), SEED_CONTRAST, np.nan)
    return whole.filled(Lattice(pixels, seeds, whole.rising)), left


def _by_outlines(
    pictures: Sequence[GreyImage], lattices: Sequence[RefinedLattice], board: Board
) -> tuple[Lattice, list[RefinedLattice]]:
    """Return the corners of a board beside markers whose outlines are seen, those of lattices that have them first,
    and the lattices that have none."""
    whole, left = _empty(board), []
    eight_bit = [np.clip(np.rint(picture), 0, 255).astype(np.uint8) for picture in pictures]
    grid, pixels = max((_marked_corners(picture, board) for picture in eight_bit), key=lambda seen: len(seen[0]))
    for item in lattices:
        placed = _placed(item.lattice, grid, pixels, board) if len(grid) else None
        if placed is None:
            left.append(item)
        else:
            whole = whole.filled(placed)
    return whole.filled(_of(board, grid, pixels)), left


def _marked_corners(image: np.ndarray, board: Board) -> tuple[IntArray, FloatArray]:
    """Return (column, row) and rough pixels of the corners that OpenCV finds between the markers, (N, 2) each."""
    pattern = board.pattern
    assert isinstance(pattern, Charuco)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, pattern.dictionary))
    ids = pattern.first_marker + np.arange(len(pattern.places(*board.size)))
    side = float(np.sqrt(board.square_x_mm * board.square_y_mm))
    target = cv2.aruco.CharucoBoard((board.columns + 1, board.rows + 1), side, pattern.marker_mm, dictionary, ids)
    target.setLegacyPattern(pattern.legacy)
    image = 255 - image if pattern.inverted else image
    detector = cv2.aruco.CharucoDetector(target)
    corners, numbers, quads, markers = detector.detectBoard(image)
    if numbers is None or corners is None:
        # OpenCV drops a board for one marker that is misread.
        if markers is None or not len(markers):
            return np.zeros((0, 2), np.int64), np.zeros((0, 2))
        return _between_markers(np.array(quads, dtype=np.float64).reshape(-1, 4, 2), np.ravel(markers), board)
    row, column = np.divmod(np.asarray(numbers, dtype=np.int64).ravel(), board.columns)
    return np.stack([column, row], axis=-1), np.asarray(corners, dtype=np.float64).reshape(-1, 2)


def _between_markers(quads: FloatArray, markers: IntArray, board: Board) -> tuple[IntArray, FloatArray]:
    """Return (column, row) and rough pixels of the corners where the two markers beside each (N, 4, 2) agree."""
    pattern = board.pattern
    assert isinstance(pattern, Charuco)
    places = pattern.places(*board.size)
    number = markers.astype(np.int64) - pattern.first_marker
    own = (number >= 0) & (number < len(places))
    if not own.any():
        return np.zeros((0, 2), np.int64), np.zeros((0, 2))
    beyond = 0.5 * (np.array(board.squares_mm) / pattern.marker_mm - 1.0)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    pixels = transferred(maps_of_quads(quads[own]), np.where(unit > 0, 1.0 + beyond, -beyond))
    grid = places[number[own]][:, None] - 1 + unit
    inside = ((grid >= 0) & (grid < board.size)).all(axis=2)
    place, given = board.index(grid[inside]), pixels[inside]
    side = np.repeat(np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=1)[:, None], 4, axis=1)[inside]
    order = np.argsort(place, kind="stable")
    place, given, side = place[order], given[order], side[order]
    both = np.flatnonzero(place[1:] == place[:-1])
    off = np.linalg.norm(given[both] - given[both + 1], axis=1)
    both = both[off < SAME_CELLS * side[both]]
    return board.grid()[place[both]], 0.5 * (given[both] + given[both + 1])


def _empty(board: Board) -> Lattice:
    pattern, shape = board.pattern, (board.rows, board.columns)
    assert isinstance(pattern, Charuco)
    # The square below the first edge has the colour of the one before the first corner; where it is white, brightness
    # grows downwards across that edge, with the angle.
    rising = pattern.first_black(board.rows) == pattern.inverted
    return Lattice(np.full((*shape, 2), np.nan), np.full(shape, np.nan), rising)


def _of(board: Board, grid: IntArray, pixels: FloatArray) -> Lattice:
    out = _empty(board)
    out.pixels[grid[:, 1], grid[:, 0]] = pixels
    out.contrast[grid[:, 1], grid[:, 0]] = SEED_CONTRAST
    return out


def _placed(lattice: Lattice, grid: IntArray, pixels: FloatArray, board: Board) -> Lattice | None:
    """Return `lattice` on the grid of the board where the marked corners say so with one voice, else None."""
    known = lattice.known
    corners = lattice.pixels[known]
    distance = np.linalg.norm(corners[:, None] - pixels, axis=2)
    nearest = distance.argmin(axis=0)
    near: BoolArray = distance[nearest, np.arange(len(pixels))] < SAME_CELLS * _side_px(lattice)
    if near.sum() < MIN_VOTES:
        return None
    row, column = np.nonzero(known)
    cell = np.stack([column, row], axis=-1)[nearest[near]]
    best: tuple[int, Lattice, IntArray] | None = None
    columns, rows = lattice.size
    for turns in range(4):
        shift, votes = np.unique(grid[near] - cell, axis=0, return_counts=True)
        if best is None or votes.max() > best[0]:
            best = (int(votes.max()), lattice.turned(turns), shift[votes.argmax()])
        # As `Lattice.turned`.
        cell = np.stack([rows - 1 - cell[:, 1], cell[:, 0]], axis=-1)
        columns, rows = rows, columns
    if best is None or best[0] < max(MIN_VOTES, AGREEING_VOTES * near.sum()):
        return None
    return _onto(best[1], best[2], board)


def _side_px(lattice: Lattice) -> float:
    steps = [np.linalg.norm(np.diff(lattice.pixels, axis=axis), axis=2).ravel() for axis in (0, 1)]
    return float(np.nanmedian(np.concatenate(steps)))


def _onto(lattice: Lattice, shift: IntArray, board: Board) -> Lattice:
    """Return the board's lattice with the corners of `lattice`, moved by (column, row); what sticks out is left out."""
    row, column = np.nonzero(lattice.known)
    place = np.stack([column, row], axis=-1) + shift
    inside = ((place >= 0) & (place < board.size)).all(axis=1)
    row, column, place = row[inside], column[inside], place[inside]
    out = _empty(board)
    out.pixels[place[:, 1], place[:, 0]] = lattice.pixels[row, column]
    out.contrast[place[:, 1], place[:, 0]] = lattice.contrast[row, column]
    return out


def _beside_markers(image: GreyImage, refined: RefinedLattice, board: Board, camera: Camera | None) -> _MarkedBoard:
    """Return the corners fitted anew with windows that leave the markers out; those that then fail are dropped."""
    known = refined.lattice.known
    if not known.any():
        return _MarkedBoard(refined, board, image, board)
    shape, blur = fit_cells(refined.lattice.pixels, known), float(np.median(refined.blur_px[known]))
    narrow = _fitted(image, refined, board, blur)
    if float(np.median(gap_to_markers(board, shape.sides))) > (NEAR_SIGMAS + MARKER_BLURS) * blur + NEAR_PX:
        return _MarkedBoard(narrow, board, image, board)
    # Their ink reaches into any window.
    given = narrow
    if not narrow.lattice.known.all():
        # Markers are wiped out around all that is seen, so that their ink is no reason to leave corners out.
        seen = completed(image, _detection(_MarkedBoard(narrow, board, image, board)), [board], camera)
        given = _with_more(narrow, seen, board)
    return _with_markers_masked(image, given, narrow.lattice.known, board, blur) or _MarkedBoard(
        narrow, board, image, board
    )


def _with_markers_masked(
    image: GreyImage, given: RefinedLattice, sure: BoolArray, board: Board, blur: float
) -> _MarkedBoard | None:
    """Return the corners `given` fitted anew in the picture without the markers, but for those that are not `sure` (R,
    C) and fit badly there; None where markers cannot be wiped out."""
    empty, some_more = replace(board, pattern=Chessboard()), bool((given.lattice.known & ~sure).any())
    picture, before, after, narrow, light = image, blur, blur, given, None
    # The places of those that were added are rough.
    for turn in range(MASKING_ROUNDS + some_more):
        # Of corners without ink it is known how much light that takes.
        masked = without_markers(image, narrow, board, after, light if turn >= MASKING_ROUNDS else None)
        if masked is None:
            return None
        (picture, light), given, before = masked, narrow, after
        fitted = _fitted(picture, given, empty, before)
        if turn > 0 and some_more:
            fitted = fitted.without(_too_unlike(fitted, sure))
        # What ink is left the first time is in no picture of empty squares, and this takes longest.
        narrow = placed_together(picture, fitted) if turn > 0 else fitted
        after = float(np.median(narrow.blur_px[narrow.lattice.known]))
    # Wide windows see how crookedly the squares are printed, as those of plain chessboards do.
    alone = narrow.sigma_px / narrow.scatter / (1.0 + _drawn_by_markers(image, light, given, narrow, board, before))
    every = (slice(0, sure.shape[0]), slice(0, sure.shape[1]))
    scatter = float(scatter_factors(narrow.lattice.pixels, alone, [every])[0])
    return _MarkedBoard(replace(narrow, sigma_px=scatter * alone, scatter=scatter), board, picture, empty)


def _drawn_by_markers(
    image: GreyImage, light: Picture | None, given: RefinedLattice, found: RefinedLattice, board: Board, blur: float
) -> float:
    """Return how far corners go back, in parts of the shift, where their markers are wiped out a little beside.

    What is left of such markers draws a corner to where it belongs. Wiped out beside corners that are off by e, they
    leave corners off by P n - c e: n is the noise, P n what it does on a chessboard, and c what is returned. Done over
    and over that ends at e = P n / (1 + c): markers, too, say where corners are.

    given, found : the corners around which markers were wiped out, and where they were then found.
    """
    off = MOVED_PX * np.random.default_rng(0).choice([-1.0, 1.0], found.lattice.pixels.shape)
    lateral = replace(given, lattice=replace(given.lattice, pixels=given.lattice.pixels + off))
    masked = without_markers(image, lateral, board, blur, light)
    if masked is None:
        return 0.0
    empty = replace(board, pattern=Chessboard())
    moved = (
        placed_together(masked.picture, _fitted(masked.picture, given, empty, blur)).lattice.pixels
        - found.lattice.pixels
    )
    back = -(moved / off)[np.isfinite(moved)]
    return max(float(np.median(back)), MIN_DRAWN) if len(back) >= MIN_MOVED else 0.0


def _fitted(image: GreyImage, refined: RefinedLattice, board: Board, blur: float) -> RefinedLattice:
    """Return the corners of `refined` fitted anew on `image`, from edges of s `blur`, without those that fail."""
    lattice = refined.lattice
    known = lattice.known
    shape = fit_cells(lattice.pixels, known)
    # A corner that a shadow crosses, or a finger, bends no lines: it is uncertain, and says so.
    curvatures = line_curvatures_to_fit(lattice.pixels, refined.sigma_px, known, shape.sides, RADIUS_PX)
    fit = fit_corners(image, board, known, shape, lattice.pixels[known], lattice.signs()[known], blur, curvatures)
    shared = shared_noise(fit, shape.sides, RADIUS_PX, marked=isinstance(board.pattern, Charuco))
    fit = with_uneven(fit, shape.sides, RADIUS_PX, shared)

    def spread(values: FloatArray) -> FloatArray:
        out = np.full((*known.shape, *values.shape[1:]), np.nan)
        out[known] = values
        return out

    fitted = replace(
        refined,
        lattice=Lattice(spread(fit.pixels), spread(fit.contrast), lattice.rising),
        sigma_px=shared * spread(fit.sigma_px),
        blur_px=spread(fit.blur),
        residual=spread(fit.residual),
        noise=spread(fit.noise),
        scatter=1.0,
        correlated=shared,
    )
    drop = known.copy()
    drop[known] = ~fit.valid | (fit.contrast <= 0.0)
    return fitted.without(drop)


def _detection(found: _MarkedBoard) -> BoardDetection:
    refined, board = found.refined, found.board
    row, column = np.nonzero(refined.lattice.known)
    grid = np.stack([column, row], axis=-1)
    pixels, sigma = refined.lattice.pixels[row, column], refined.sigma_px[row, column]
    return BoardDetection(board.board_id, board.columns, board.rows, grid, pixels, sigma)
