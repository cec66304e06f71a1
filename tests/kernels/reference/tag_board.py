"""The fit of a board of tags, in numpy: what the kernels of tag_board.c and tag_rounds.c do."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from kernels.reference.edges import blur_of_tags, fit_tag_corners

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, known_median, rows_where
from rigkit.core.detections import BoardDetection, grid_turned
from rigkit.detection.guided.board_guide import MIN_GUIDE_CORNERS, BoardState, Guide
from rigkit.detection.guided.corner_fit import MARKER_BLURS
from rigkit.detection.guided.guided import (
    MARGIN_PX,
    MAX_ADDED_RESIDUAL_MARKED,
    MAX_SIGMA_CELLS,
    MIN_ADDED_CONTRAST,
    SCATTER_FLOOR_PX,
)
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.subpixel.consistent import DISPLACED_CELLS, MOVED_CELLS
from rigkit.detection.subpixel.correlation import board_factors
from rigkit.detection.subpixel.edge_fit import EdgeFit, edge_rules
from rigkit.detection.subpixel.edge_model import WINDOW_REACH
from rigkit.detection.subpixel.scatter import UNEXPLAINED_SCATTER
from rigkit.detection.subpixel.subpixel import FIRST_BLUR, FIRST_PASS, LAST_PASS
from rigkit.detection.tags.codes import MIN_PREDICTED_LIKENESS, read_tags
from rigkit.detection.tags.corners import (
    BETTER_KNOWN,
    CURVED_SIGMAS,
    FEW_CORNERS,
    MAX_PREDICTED_GAIN,
    MAX_TAG_ROUNDS,
    MIN_EDGE_CONTRAST,
    MIN_PREDICTING_CORNERS,
    MIN_TAG_CORNERS,
    NOTHING_NEAR_PX,
    OUTLIER_TEST_GAIN,
    ROUGH_PX,
    TAG_OUTLIER,
    WIDE_BLUR,
)
from rigkit.detection.tags.placing import TagBoard
from rigkit.detection.tags.surface import SmoothMap, seen_surface
from rigkit.detection.tags.whole_tags import NARROW_BLURS, WHOLE_ROUNDS, with_whole_tags
from rigkit.kernels.edges import Rules, TagWindow
from rigkit.kernels.surface import TagSurface
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

AROUND_NEW = np.ones((5, 5), np.uint8)
"""A corner that was not seen where it was foretold is sought again when one so near is found."""

CORNERS_OF_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""(column, row) of the corners of a square from its first, in the order of growing angle from u to v."""

TagCorners = tuple[GreyImage, BoolArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""The first arguments of `fit_tag_corners`."""


def tag_corners(image: GreyImage, tags: TagBoard, pixels: FloatArray, camera: Camera | None) -> BoardDetection | None:
    """Return the corners of a board whose rough corners are `pixels` (R, C, 2), NaN where unknown; None for too few.

    Corners that the rough ones foretell, or a calibrated `camera`, are added where they are seen.
    """
    fitter = _Fitter(image, tags, camera)
    state = fitter.first(pixels)
    if np.count_nonzero(state.known) < MIN_TAG_CORNERS:
        return None
    # What the lattice lacks is added before corners are fitted again; what only finer ones foretell, after that.
    state = fitter.completed(fitter.again(state))
    state = fitter.without_outliers(state)
    row, column = np.nonzero(state.known)
    if len(row) < MIN_TAG_CORNERS:
        return None
    state, factor = fitter.last(state)
    row, column = np.nonzero(state.known)
    board = tags.board
    grid = np.stack([column, row], axis=-1)
    return BoardDetection(
        board.board_id, *board.size, grid, state.pixels[row, column], factor * state.sigma_px[row, column]
    )


class _Fitter:
    """The fit of one board's corners in one image."""

    def __init__(self, image: GreyImage, tags: TagBoard, camera: Camera | None) -> None:
        self.image, self.tags, self.camera = image, tags, camera
        self.places, self.steps, self.signs = tags.places, tags.steps, tags.signs
        self.reach = np.minimum(0.5 * np.maximum(self.steps[..., 0], self.steps[..., 1]), WINDOW_REACH)
        self.window = TagWindow.of(
            border=tags.pattern.border / tags.codes.modules, blurs=MARKER_BLURS, nothing_near=NOTHING_NEAR_PX
        )
        self._mapped: tuple[BoardState, SmoothMap] | None = None
        self._fitted: tuple[EdgeFit, FloatArray, float] | None = None
        self._vain, self._waiting = np.zeros((2, *self.signs.shape), np.bool_)
        self.curvature = np.full(self.places.shape, np.nan)

    def map_of(self, state: BoardState) -> SmoothMap:
        """Return the map through the known corners; that of the last state asked for is kept."""
        if self._mapped is None or self._mapped[0] is not state:
            base = None
            if self.camera is not None and np.count_nonzero(state.known) >= MIN_GUIDE_CORNERS:
                pose = Guide.of(self.tags.board, self.camera, state).cam_from_board
                if pose is not None:
                    base = partial(seen_surface, self.camera, pose, np.array(self.tags.board.squares_mm))
            known = state.known
            self._mapped = state, SmoothMap(rows_where(self.places, known), rows_where(state.pixels, known), base)
        return self._mapped[1]

    def fit(
        self,
        cells: BoolArray,
        surface: TagSurface,
        start: FloatArray,
        blur: FloatArray | float,
        stage: tuple[float, int, float],
        *,
        mirrored: bool = True,
    ) -> EdgeFit:
        """Fit the edge model at the `cells`; arguments else as of `fit_edges`."""
        self.curvature.reshape(-1, 2)[cells.reshape(-1).nonzero()[0]] = surface.curvature
        fitted = fit_tag_corners(
            *self._corners(cells, surface, start), np.full(len(start), blur), self.window, self._rules(stage, mirrored)
        )
        return EdgeFit(fitted)

    def _rules(self, stage: tuple[float, int, float], mirrored: bool) -> Rules:
        return edge_rules(*stage, mirrored and self.tags.pattern.corner_squares, self.image.dtype == np.uint8)

    def _corners(self, cells: BoolArray, surface: TagSurface, start: FloatArray) -> TagCorners:
        """Return what `kernels.edges.fit_tag_corners` is packed of the corners at `cells`."""
        if self.tags.pattern.corner_squares:
            single, contrast = np.zeros((len(start), 2)), np.full(len(start), np.nan)
        else:
            row, column = (np.where(part % 2 == 0, 1.0, -1.0) for part in np.nonzero(cells))
            # Line 1 runs along the row; +90 degrees from it are down, and from line 2 to the left.
            single = np.stack([row, -column], axis=1)
            contrast = self._contrast(np.stack([column, row], axis=1), surface, start)
        return self.image, cells, self.steps, self.signs, start, surface.rows, single, contrast

    def _contrast(self, inside: FloatArray, surface: TagSurface, start: FloatArray) -> FloatArray:
        """Return the contrast (M,) of the corners of lone tags that lie on the sides `inside` (M, 2) of them, +1 or -1
        along the columns and rows."""
        pattern = self.tags.pattern
        inwards = (inside[:, None] @ surface.sides)[:, 0]
        ink = start + 0.5 * pattern.border / self.tags.codes.modules * inwards
        paper = start - 0.25 * pattern.spacing * inwards
        return np.asarray(0.5 * np.maximum(sample(self.image, paper) - sample(self.image, ink), MIN_EDGE_CONTRAST))

    def first(self, pixels: FloatArray) -> BoardState:
        """Return the rough corners fitted, those that failed left out, and those missing that they foretell."""
        rough = BoardState.unfitted(pixels, np.full(pixels.shape[:2], np.nan))
        state = self.fitted(rough, None)
        more = self.added(state, self.map_of(rough))
        return state if more is None else self.completed(more)

    def _blur(self, cells: BoolArray, surface: TagSurface, pixels: FloatArray) -> float:
        """Return s of corners at `cells`, roughly at `pixels` (M, 2), by a quick fit of a few of them."""
        apart = max(len(pixels) // FEW_CORNERS, 1)
        corners = self._corners(cells, surface, pixels)
        blur = blur_of_tags(*corners, apart, FIRST_BLUR, self.window, self._rules(FIRST_PASS, False))
        return blur if np.isfinite(blur) else FIRST_BLUR

    def completed(self, state: BoardState) -> BoardState:
        """Return the state with the missing corners that are seen, each round of them foretold by those before."""
        for _ in range(MAX_TAG_ROUNDS):
            more = self.added(state)
            if more is None:
                break
            state = more
        return state

    def fitted(self, state: BoardState, blur: float | None) -> BoardState:
        """Return the state with all its corners fitted, with lines that bend as they have it themselves, without those
        that failed; the fit is kept. Where `blur` is not known, a quick fit tells it."""
        cells = state.known
        smooth = self.map_of(state)
        surface = smooth.at(rows_where(self.places, cells))
        seen = surface.seen
        if not seen.all():
            cells[cells] = seen
            surface = surface.of(seen)
        start = rows_where(state.pixels, cells)
        blur = self._blur(cells, surface, start) if blur is None else blur
        fit = self.fit(cells, surface, start, blur, LAST_PASS)
        self._fitted = fit, surface.sides, smooth.scatter()
        self._vain[:] = self._waiting[:] = False
        nothing = state.without(np.ones(cells.shape, dtype=bool))
        return nothing.with_fit(cells, fit, fit.valid & (fit.contrast > 0.0))

    def again(self, state: BoardState) -> BoardState:
        """Return the state with those corners fitted again whose lines bend otherwise than when they were fitted, if
        that is known better now."""
        assert self._fitted is not None
        smooth, before = self.map_of(state), self._fitted[2]
        scatter = smooth.scatter()
        if scatter > BETTER_KNOWN * before:
            return state
        self._vain[:] = self._waiting[:] = False
        cells = state.known
        surface = smooth.at(rows_where(self.places, cells))
        half = np.minimum(rows_where(self.reach, cells) * surface.lengths, LAST_PASS[0])
        # A line of curvature k lies off its chord by k w^2 / 6 in the mean over w to either side.
        curvatures = np.abs(surface.curvature - rows_where(self.curvature, cells))
        # Of two columns; max(axis=1) takes ten times as long.
        off = np.maximum(curvatures[:, 0], curvatures[:, 1]) * np.maximum(half[:, 0], half[:, 1]) ** 2 / 6.0
        bent = (before > ROUGH_PX) | ~(off < CURVED_SIGMAS * np.maximum(state.sigma_px[cells], scatter))
        if not bent.any():
            return state
        blur = known_median(state.blur)
        if 2 * np.count_nonzero(bent) > len(bent):
            return self.fitted(state, blur)
        cells[cells] = bent
        fit = self.fit(cells, surface.of(bent), rows_where(state.pixels, cells), blur, LAST_PASS)
        return state.without(cells).with_fit(cells, fit, fit.valid & (fit.contrast > 0.0))

    def added(self, state: BoardState, smooth: SmoothMap | None = None) -> BoardState | None:
        """Return the state with those missing corners that can be added now, None where there are none; `smooth`
        foretells them, by default the state's own map."""
        missing = ~(state.known | self._vain | self._waiting)
        if not missing.any() or np.count_nonzero(state.known) < MIN_PREDICTING_CORNERS:
            return None
        smooth = smooth or self.map_of(state)
        surface = smooth.beyond(rows_where(self.places, missing))
        height, width = self.image.shape
        u, v = surface.pixels.T
        usable = (surface.gain < MAX_PREDICTED_GAIN) & (u > MARGIN_PX) & (u < width - 1.0 - MARGIN_PX)
        usable &= (v > MARGIN_PX) & (v < height - 1.0 - MARGIN_PX)
        if not usable.any():
            return None
        cells = missing.copy()
        cells[missing] = usable
        surface = surface.of(usable)
        blur = known_median(state.blur)
        start = surface.pixels
        if (smooth.scatter() * surface.gain > blur).any():
            wide = np.maximum(blur, WIDE_BLUR * self.tags.pattern.spacing * surface.height)
            rough = self.fit(cells, surface, start, wide, LAST_PASS, mirrored=False)
            start = np.where(rough.valid[:, None], rough.pixels, start)
        fit = self.fit(cells, surface, start, blur, LAST_PASS)
        good = self._there(state, cells, surface, fit, blur)
        more = state.with_fit(cells, fit, good)
        # What was foretold as well as corners are known is not there; other corners may be foretold by those new.
        self._vain[cells], self._waiting[cells] = surface.gain <= 1.0, True
        if not good.any():
            return None
        self._waiting &= cv2.dilate((more.known & ~state.known).astype(np.uint8), AROUND_NEW) == 0
        return more

    def _there(self, state: BoardState, cells: BoolArray, surface: TagSurface, fit: EdgeFit, blur: float) -> BoolArray:
        """Return which corners (M,) fitted at the missing `cells` are those that the state's foretell by `surface`."""
        gap = self.tags.pattern.spacing * surface.height
        moved = np.hypot(*(fit.pixels - surface.pixels).T)
        contrast, residual = known_median(state.contrast), known_median(state.residual)
        seen = fit.valid & (moved < np.maximum(MOVED_CELLS, MOVED_CELLS * surface.gain) * gap)
        seen &= fit.contrast > MIN_ADDED_CONTRAST * contrast
        clean = fit.residual < MAX_ADDED_RESIDUAL_MARKED * residual * np.maximum(1.0, fit.contrast / contrast)
        clean &= fit.sigma_px < MAX_SIGMA_CELLS * gap
        # The code is in the windows of narrow borders, but says itself that the tag is there.
        coded = seen & ~clean & (self.borders(surface) < NARROW_BLURS * blur)
        if coded.any():
            pixels = state.pixels.copy()
            pixels[cells] = np.where(seen[:, None], fit.pixels, surface.pixels)
            coded &= self.read(pixels)[cells]
        return np.asarray(seen & (clean | coded))

    def borders(self, surface: TagSurface) -> FloatArray:
        """Return how wide the borders of tags are at places of the map, (M,) px."""
        return np.asarray(self.tags.pattern.border / self.tags.codes.modules * surface.height)

    def read(self, pixels: FloatArray) -> BoolArray:
        """Return the corners (R, C) of tags whose codes are read in their places, by all corners (R, C, 2)."""
        quads = np.stack([pixels[::2, ::2], pixels[::2, 1::2], pixels[1::2, 1::2], pixels[1::2, ::2]], axis=2)
        whole = np.asarray(np.isfinite(quads).all(axis=(2, 3)))
        tags = read_tags(self.image, quads[whole], self.tags.codes)
        own = (tags.number == self.tags.numbers[whole]) & (tags.turns == 0)
        whole[whole] = own & (tags.likeness >= MIN_PREDICTED_LIKENESS)
        return whole.repeat(2, axis=0).repeat(2, axis=1)

    def without_outliers(self, state: BoardState) -> BoardState:
        """Return the state without corners that lie where those around them cannot have them."""
        for _ in range(MAX_TAG_ROUNDS):
            cells = state.known
            if np.count_nonzero(cells) < MIN_GUIDE_CORNERS:
                return state
            smooth = self.map_of(state)
            off, gain = smooth.left_out()
            off = np.nan_to_num(off) / gain
            typical = max(known_median(off), SCATTER_FLOOR_PX)
            typical_sigma = known_median(state.sigma_px[cells])
            sigma = np.minimum(state.sigma_px[cells], 3.0 * typical_sigma)
            allowed = TAG_OUTLIER * np.hypot(typical, sigma)
            if not ((gain < OUTLIER_TEST_GAIN) & (off > allowed)).any():
                return state
            gap = self.tags.pattern.spacing * smooth.at(rows_where(self.places, cells)).height
            excess = np.where(gain < OUTLIER_TEST_GAIN, off / np.maximum(allowed, DISPLACED_CELLS * gap), 0.0)
            # Those that contradict the most go first: they may be all that speaks against their neighbours.
            worst = excess > max(1.0, 0.5 * float(excess.max()))
            if not worst.any():
                return state
            drop = cells.copy()
            drop[cells] = worst
            state = state.without(drop)
        return state

    def last(self, state: BoardState) -> tuple[BoardState, float]:
        """Return the corners as they finally are, and the factor of their sigmas."""
        assert self._fitted is not None
        fit, sides, _ = self._fitted
        owner, factor = np.zeros(len(sides), np.int64), 1.0
        if self.tags.pattern.corner_squares:
            good = fit.valid & (fit.contrast > 0.0)
            factor = float(board_factors(fit, good, sides, owner, 1, LAST_PASS[0])[0][0])
        for rules in WHOLE_ROUNDS:
            whole = with_whole_tags(self.image, self.tags, self.places, state, partial(self.map_of, state), rules)
            if whole is state:
                break
            state = whole
        cells = state.known
        if np.count_nonzero(cells) >= MIN_GUIDE_CORNERS:
            off, gain = self.map_of(state).left_out()
            expected = factor * state.sigma_px[cells] * np.hypot(1.0, gain)
            scatter = known_median(off / expected) / MEDIAN_OF_RAYLEIGH
            factor *= scatter if scatter > UNEXPLAINED_SCATTER else 1.0
        return state, factor


def squares_of(lattice: Lattice, *, dark: bool) -> tuple[FloatArray, IntArray]:
    known, corners = lattice.known, lattice.pixels
    row, column = np.nonzero(known[:-1, :-1] & known[:-1, 1:] & known[1:, 1:] & known[1:, :-1])
    dark_ones = (row + column) % 2 == (1 if lattice.rising else 0)
    row, column = row[dark_ones == dark], column[dark_ones == dark]
    quads = corners[row[:, None] + CORNERS_OF_SQUARE[:, 1], column[:, None] + CORNERS_OF_SQUARE[:, 0]]
    return quads, np.stack([column, row], axis=-1)


def voted_place(lattice: Lattice, cells: IntArray, turns: IntArray, places: IntArray) -> tuple[int, int, IntArray]:
    columns, rows = lattice.size
    back = -turns % 4
    turned, square = cells, (columns - 1, rows - 1)
    for turn in set(back.tolist()):
        turned = np.where((back == turn)[:, None], grid_turned(cells, square, turn), turned)
    shift = places - turned
    # Numbered, to be counted.
    low = shift.min(axis=0)
    width, height = (shift.max(axis=0) - low + 1).tolist()
    seats = (back * width + shift[:, 0] - low[0]) * height + shift[:, 1] - low[1]
    votes = np.bincount(seats)
    most = int(votes.argmax())
    first = int((seats == most).argmax())
    return int(votes[most]), int(back[first]), shift[first]
