"""ChArUco boards: corners of our own detector, placed on the board by its markers.

The markers in the squares of a lattice determine its rotation and shift on the board by vote, so that a misread marker
has no effect. If they do not, OpenCV detects markers by their outlines; corners beside these determine the places of
lattices, and replace missed corners or lattices. All corners are refined by the edge model, as those of other boards.
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
from rigkit.detection.guided.corner_fit import MARKER_BLURS, RADIUS_PX, fit_corners, gap_to_markers
from rigkit.detection.guided.guided import MAX_ADDED_RESIDUAL_MARKED, completed
from rigkit.detection.guided.lopsided_blur import blur_shift_px
from rigkit.detection.guided.relit import relit
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.saddles.response import GreyImage, as_bytes
from rigkit.detection.subpixel.correlation import with_uneven
from rigkit.detection.subpixel.edge_curvature import line_curvatures_to_fit
from rigkit.detection.subpixel.edge_model import NEAR_PX, TAIL_SIGMAS
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import scatter_factor
from rigkit.detection.subpixel.subpixel import refine
from rigkit.detection.subpixel.uncertain_corners import sigmas_beside_edges
from rigkit.detection.subpixel.whole_board import placed_together
from rigkit.detection.tags.codes import transferred
from rigkit.detection.tags.in_squares import AGREEING_MARKERS, MIN_MARKERS, between_markers, confirmed, place_by_markers
from rigkit.detection.tags.without_markers import without_markers
from rigkit.detection.targets.base import Finder, Search
from rigkit.kernels.boards import Picture
from rigkit.kernels.surface import maps_of_quads

SAME_CELLS = 0.2
"""Largest distance of a marker's corner from the same corner of a lattice, in sides of a cell."""
MASKING_ROUNDS, MAX_MASKING_ROUNDS, SETTLED_MASK, MAX_FURTHER = 2, 8, 0.15, 1.5
"""Rounds of removing markers and fitting corners: the second starts from corners that their ink does not affect; more
follow until corners would move by less than this part of their sigmas. Out of focus each leaves 0.7 of the errors
(RENDERED, blur 3 px, squares of 20 to 30 px): after two rounds they are twice those after eight. Each begins at most
this many times the last movement further on: more is only measured where rounds hardly converge, and there corners are
carried away (RENDERED, markers of 0.9 of their squares: by 2 px)."""

MOVED_LINE_PX, MIN_MOVED, MIN_DRAWN = 0.05, 12, -0.75
"""Random shift, per coordinate, of the corners around which markers are removed, to measure its effect on the fit;
smallest number of coordinates for this; and lower limit of the effect, which makes sigmas four times as large (measured
out of focus: -0.5 to -0.6)."""

SEED_CONTRAST = 100.0
"""Initial contrast of a corner, in grey levels; the fit determines it."""


class CharucoFinder(Finder):
    """Returns lattices placed by their markers; chessboards then do not use them."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        found, rest = _charuco_boards(search, search.lattices, boards)
        search.leave(rest)
        every = [completed(item.picture, _detection(item), [item.shown], search.camera) for item in found]
        if search.quick:
            return every
        pairs = zip(every, found, strict=True)
        return [_less_sure(relit(search.grey, seen, item.refined, item.board), item) for seen, item in pairs]


def _too_unlike(fitted: RefinedLattice, sure: BoolArray) -> BoolArray:
    """Return which corners (R, C), except those that are `sure`, have far larger residuals than these."""
    left = fitted.relative_residual
    with np.errstate(invalid="ignore"):
        return np.asarray(~sure & (left > MAX_ADDED_RESIDUAL_MARKED * known_median(left[sure])))


def _with_more(refined: RefinedLattice, detection: BoardDetection, board: Board) -> RefinedLattice:
    """Return `refined` with the missing corners from a detection on its grid; `refined` itself if there are none."""
    more = _of(board, detection.grid, detection.pixels)
    sigma = np.full(refined.sigma_px.shape, np.nan)
    sigma[detection.grid[:, 1], detection.grid[:, 0]] = detection.sigma_px
    if not (more.known & ~refined.lattice.known).any():
        return refined
    typical = np.full(sigma.shape, known_median(refined.blur_px))
    return refined.filled(replace(refined, lattice=more, sigma_px=sigma, blur_px=typical))


@dataclass(frozen=True, eq=False, slots=True)
class _MarkedBoard:
    """A board's corners on its grid, the picture of their last fit, and the board `shown` there: if markers were
    removed, the plain squares of the `board`."""

    refined: RefinedLattice
    board: Board
    picture: GreyImage
    shown: Board


def _charuco_boards(
    search: Search, found: Sequence[RefinedLattice], boards: Sequence[Board]
) -> tuple[list[_MarkedBoard], list[RefinedLattice]]:
    """Return the ChArUco boards in an image on their own grids, and the lattices that belong to none.

    Parameters
    ----------
    search : the image.
    found : all lattices in the image.
    boards : the ChArUco boards that may be in it.
    """
    image, rest = search.grey, list(found)
    pictures = [image] if search.stored is image else [image, search.stored]
    out = []
    for board in boards:
        whole, left = _by_squares(image, rest, board)
        if 2 * whole.count < whole.known.size:
            # Strips on both sides of an arm may be no lattices.
            whole, left = max((whole, left), _by_outlines(pictures, rest, board), key=lambda way: way[0].count)
        if not whole.count:
            continue
        placed = _beside_markers(image, refine(image, [whole])[0], board, search.camera)
        if placed.refined.lattice.count >= search.min_corners_of(board):
            out.append(placed)
            rest = left
    return out, rest


def _by_squares(
    image: GreyImage, lattices: Sequence[RefinedLattice], board: Board
) -> tuple[Lattice, list[RefinedLattice]]:
    """Return the corners of a board in lattices placed by the markers in their squares, and the other lattices."""
    whole, left = _empty(board), []
    for item in sorted(lattices, key=lambda item: -item.lattice.count):
        place = place_by_markers(image, item.lattice, board)
        part = _empty(board) if place is None else _onto(item.lattice.turned(place[0]), place[1], board)
        # Two parts of one board do not overlap: a lattice that overlaps another is of an identical board.
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
    """Return the corners of a board beside markers detected by their outlines, from lattices where these have them, and
    the lattices that have none; no corners where other markers are read between them (of a board of other columns)."""
    whole, left = _empty(board), []
    seen = (_marked_corners(as_bytes(picture), board) for picture in pictures)
    grid, pixels = max(seen, key=lambda corners: len(corners[0]))
    for item in lattices:
        placed = _placed(item.lattice, grid, pixels, board) if len(grid) else None
        if placed is None:
            left.append(item)
        else:
            whole = whole.filled(placed)
    whole = whole.filled(_of(board, grid, pixels))
    sure = any(confirmed(picture, whole.pixels, board) for picture in pictures)
    return (whole, left) if sure else (_empty(board), list(lattices))


def _marked_corners(image: np.ndarray, board: Board) -> tuple[IntArray, FloatArray]:
    """Return (column, row) and approximate pixels, (N, 2) each, of the corners that OpenCV finds between markers."""
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
        # OpenCV rejects a board because of one misread marker.
        if markers is None or not len(markers):
            return np.zeros((0, 2), np.int64), np.zeros((0, 2))
        return _between_markers(np.array(quads, dtype=np.float64).reshape(-1, 4, 2), np.ravel(markers), board)
    row, column = np.divmod(np.asarray(numbers, dtype=np.int64).ravel(), board.columns)
    return np.stack([column, row], axis=-1), np.asarray(corners, dtype=np.float64).reshape(-1, 2)


def _between_markers(quads: FloatArray, markers: IntArray, board: Board) -> tuple[IntArray, FloatArray]:
    """Return (column, row) and approximate pixels of the corners on which both adjacent markers (N, 4, 2) agree."""
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
    # The square below the first edge has the colour of the one before the first corner. If it is white, brightness
    # increases downwards across that edge, with the angle.
    rising = pattern.first_black(board.rows) == pattern.inverted
    return Lattice(np.full((*shape, 2), np.nan), np.full(shape, np.nan), rising)


def _of(board: Board, grid: IntArray, pixels: FloatArray) -> Lattice:
    out = _empty(board)
    out.pixels[grid[:, 1], grid[:, 0]] = pixels
    out.contrast[grid[:, 1], grid[:, 0]] = SEED_CONTRAST
    return out


def _placed(lattice: Lattice, grid: IntArray, pixels: FloatArray, board: Board) -> Lattice | None:
    """Return `lattice` on the grid of the board if most marked corners agree on its place, else None."""
    known = lattice.known
    corners = lattice.pixels[known]
    distance = np.linalg.norm(corners[:, None] - pixels, axis=2)
    nearest = distance.argmin(axis=0)
    sides = [np.linalg.norm(np.diff(lattice.pixels, axis=axis), axis=2).ravel() for axis in (0, 1)]
    near: BoolArray = distance[nearest, np.arange(len(pixels))] < SAME_CELLS * known_median(np.concatenate(sides))
    if near.sum() < MIN_MARKERS:
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
    if best is None or best[0] < max(MIN_MARKERS, AGREEING_MARKERS * near.sum()):
        return None
    return _onto(best[1], best[2], board)


def _onto(lattice: Lattice, shift: IntArray, board: Board) -> Lattice:
    """Return the corners of `lattice`, shifted by (column, row), on the board's grid, without those outside of it."""
    row, column = np.nonzero(lattice.known)
    place = np.stack([column, row], axis=-1) + shift
    inside = ((place >= 0) & (place < board.size)).all(axis=1)
    row, column, place = row[inside], column[inside], place[inside]
    out = _empty(board)
    out.pixels[place[:, 1], place[:, 0]] = lattice.pixels[row, column]
    out.contrast[place[:, 1], place[:, 0]] = lattice.contrast[row, column]
    return out


def _beside_markers(image: GreyImage, refined: RefinedLattice, board: Board, camera: Camera | None) -> _MarkedBoard:
    """Return the corners fitted again in windows without markers; those whose fit fails are dropped."""
    known = refined.lattice.known
    if not known.any():
        return _MarkedBoard(refined, board, image, board)
    shape, blur = fit_cells(refined.lattice.pixels, known), float(np.median(refined.blur_px[known]))
    narrow = _fitted(image, refined, board, blur)
    if float(np.median(gap_to_markers(board, shape.sides))) > (TAIL_SIGMAS + MARKER_BLURS) * blur + NEAR_PX:
        return _MarkedBoard(_with_scatter(narrow), board, image, board)
    # Blurred ink of the markers reaches into any window.
    given = narrow
    if not narrow.lattice.known.all():
        # Missed corners are added first, so that the ink of markers is no reason to reject them.
        seen = completed(image, _detection(_MarkedBoard(narrow, board, image, board)), [board], camera)
        given = _with_more(narrow, seen, board)
    return _with_markers_masked(image, given, narrow.lattice.known, board, blur) or _MarkedBoard(
        _with_scatter(narrow), board, image, board
    )


def _with_scatter(refined: RefinedLattice, drawn: float = 0.0) -> RefinedLattice:
    """Return a board's corners with sigmas for their scatter, as those of plain chessboards: prints are irregular.

    `drawn` : relative shift by the markers around them (`_drawn_by_markers`), which their sigmas do not include yet.
    """
    alone = refined.sigma_px / refined.scatter / (1.0 + drawn)
    scatter = scatter_factor(refined.lattice.pixels, alone)
    return replace(refined, sigma_px=scatter * alone, scatter=scatter)


def _with_markers_masked(
    image: GreyImage, given: RefinedLattice, sure: BoolArray, board: Board, blur: float
) -> _MarkedBoard | None:
    """Return the corners `given`, fitted again in the picture without markers, except those that are not `sure` (R, C)
    and fit badly there; None if markers cannot be removed."""
    empty, some_more = replace(board, pattern=Chessboard()), bool((given.lattice.known & ~sure).any())
    picture, before, after, narrow, light, drawn = image, blur, blur, given, None, 0.0
    # The added corners are only approximate: they need one round more.
    enough = MASKING_ROUNDS + some_more
    for turn in range(MAX_MASKING_ROUNDS):
        if turn == enough:
            drawn = _drawn_by_markers(image, light, given, narrow, board, before)
        # By how much all further rounds would move corners; with a positive effect there is hardly anything left.
        more = min(max(-drawn, 0.0) / (1.0 + drawn), MAX_FURTHER)
        further = more * np.nan_to_num(narrow.lattice.pixels - given.lattice.pixels)
        if turn >= enough and np.mean(further**2) < (SETTLED_MASK * known_median(narrow.sigma_px) / (1.0 + drawn)) ** 2:
            break
        given = narrow.of(replace(narrow.lattice, pixels=narrow.lattice.pixels + further))
        # Later rounds use the loss of light measured around corners that ink does not affect.
        masked = without_markers(image, given, board, after, light if turn >= MASKING_ROUNDS else None)
        if masked is None:
            return None
        (picture, light), before = masked, after
        fitted = _fitted(picture, given, empty, before)
        if turn > 0 and some_more:
            fitted = fitted.without(_too_unlike(fitted, sure))
        # After the first removal there is ink left, which the picture of plain squares lacks; and this step is slow.
        narrow = placed_together(picture, fitted) if turn > 0 else fitted
        after = float(np.median(narrow.blur_px[narrow.lattice.known]))
    return _MarkedBoard(_with_scatter(narrow, drawn), board, picture, empty)


def _drawn_by_markers(
    image: GreyImage, light: Picture | None, given: RefinedLattice, found: RefinedLattice, board: Board, blur: float
) -> float:
    """Return the shift of corners when markers are removed around shifted corners, relative to minus that shift.

    The remaining ink of such markers attracts a corner to its true position. Removed around corners with errors e, they
    leave corners with errors P n - c e: n is the noise, P n its effect on a chessboard, and c is returned. Iteration
    converges to e = P n / (1 + c), because markers, too, contain information on the corners.

    given, found : the corners around which markers were removed, and as they were then fitted.
    """
    off = MOVED_LINE_PX * np.random.default_rng(0).choice([-1.0, 1.0], found.lattice.pixels.shape)
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
    """Return the corners of `refined` fitted again in `image` with initial blur s `blur`, without those that fail."""
    lattice = refined.lattice
    known = lattice.known
    shape = fit_cells(lattice.pixels, known)
    # A corner in a shadow or beside a finger has a large sigma, so that it does not bend its lines.
    curvatures = line_curvatures_to_fit(lattice.pixels, refined.sigma_px, known, shape.sides, RADIUS_PX)
    fit = fit_corners(image, board, known, shape, lattice.pixels[known], lattice.signs()[known], blur, curvatures)
    fit, shared = with_uneven(fit, shape.sides, RADIUS_PX, marked=isinstance(board.pattern, Charuco))

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


def _less_sure(detection: BoardDetection, found: _MarkedBoard) -> BoardDetection:
    """Return `detection` with sigmas that include the common shift of its corners by lopsided blur."""
    if isinstance(found.shown.pattern, Charuco):
        return detection
    shift_px = blur_shift_px(found.picture, found.refined, found.shown)
    return replace(detection, sigma_px=np.hypot(detection.sigma_px, shift_px)) if shift_px > 0.0 else detection


def _detection(found: _MarkedBoard) -> BoardDetection:
    refined, board = found.refined, found.board
    row, column = np.nonzero(refined.lattice.known)
    grid = np.stack([column, row], axis=-1)
    pixels, sigma = refined.lattice.pixels[row, column], sigmas_beside_edges(refined)[row, column]
    return BoardDetection(board.board_id, board.columns, board.rows, grid, pixels, sigma)
