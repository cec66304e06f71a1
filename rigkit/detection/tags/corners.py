"""The subpixel fit of the corners of a board of tags.

Lone tags have corners of single squares: a variant of the edge model is fitted to them, and all its residuals count as
noise.

If small squares fill the corners between tags, the corners are saddles like those of chessboards, but their lines are
unevenly spaced: the neighbours are a side of a tag away in one direction, and the gap to the next tag in the other. The
edge model is fitted in windows that reach half way to the neighbours, and are narrow enough to end before the tag's
code. Tags that are too small for that are fitted as a whole (`rigkit.detection.tags.whole_tags`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from functools import partial

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, rows_where
from rigkit.core.detections import BoardDetection
from rigkit.detection.guided.board_guide import FITTED, MIN_GUIDE_CORNERS, BoardState, Guide
from rigkit.detection.guided.corner_fit import MARKER_BLURS
from rigkit.detection.guided.guided import (
    MARGIN_PX,
    MAX_ADDED_RESIDUAL_MARKED,
    MAX_SIGMA_CELLS,
    MIN_ADDED_CONTRAST,
    SCATTER_FLOOR_PX,
)
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.consistent import DISPLACED_CELLS, MOVED_CELLS
from rigkit.detection.subpixel.correlation import factor_rules
from rigkit.detection.subpixel.edge_fit import edge_rules
from rigkit.detection.subpixel.scatter import UNEXPLAINED_SCATTER
from rigkit.detection.subpixel.subpixel import FIRST_BLUR, FIRST_PASS, LAST_PASS
from rigkit.detection.tags.codes import MIN_CODE_CONTRAST, MIN_PREDICTED_LIKENESS
from rigkit.detection.tags.placing import TagBoard
from rigkit.detection.tags.surface import MAX_LEVERAGE, NEAREST_DEPTH, POINTS_A_TERM, SmoothMap, seen_surface
from rigkit.detection.tags.whole_tags import NARROW_BLURS, WHOLE_ROUNDS, with_whole_tags
from rigkit.kernels.edges import TagWindow
from rigkit.kernels.surface import HARDLY_MORE, TagSurface
from rigkit.kernels.tag_board import CORNER_COLUMNS, TagBoardFit, TagCornerRules
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

MIN_TAG_CORNERS = 4
"""Smallest number of corners of a board: those of one tag."""

MIN_PREDICTING_CORNERS = 8
"""Smallest number of corners from which missing ones are predicted: those of two tags."""

MAX_PREDICTED_GAIN = 4.0
"""Largest standard deviation of a prediction from neighbouring corners of standard deviation 1."""

WIDE_BLUR = 0.15
"""Blur of the first fit of a missing corner with an uncertain prediction, in widths of the gap between tags."""

MAX_TAG_ROUNDS = 12
"""Largest number of rounds in which missing corners are added, or outliers dropped, each after a new map."""

NOTHING_NEAR_PX, MIN_EDGE_CONTRAST = 1e4, 10.0
"""Distance of neighbouring lines from lone tags, large enough to have no effect; and smallest initial contrast, in grey
levels."""

FEW_CORNERS = 12
"""Number of corners from which the blur of the image is estimated, to a few hundredths."""

BETTER_KNOWN, ROUGH_PX = 0.5, 0.25
"""Corners are fitted again with new curvatures of their lines only if the scatter of the corners is at most this part
of the scatter of those that gave the old curvatures: otherwise the new ones are as inaccurate. All are fitted again if
the old scatter exceeds ROUGH_PX: that of saddles never does, only that of corners of outlines, at whole pixels."""

CURVED_SIGMAS = 0.3
"""Smallest deviation of a corner's lines from those that it was fitted with, in its sigmas, for which it is fitted
again: ignored, it would add a twentieth to the error."""

TAG_OUTLIER, OUTLIER_TEST_GAIN = 6.0, 1.5
"""Smallest leave-one-out error of an outlier, for example a partly covered corner, relative to the typical error and
its own sigma combined; and largest gain of predictions for this test: at the ends of a board they are inaccurate."""


def tag_corners(image: GreyImage, tags: TagBoard, pixels: FloatArray, camera: Camera | None) -> BoardDetection | None:
    """Return the corners of a board from approximate ones, `pixels` (R, C, 2), NaN where unknown; None if too few fit.

    Missing corners that can be predicted, by the others or by a calibrated `camera`, are added if they are visible.
    """
    fitter = _Fitter(image, tags, pixels, camera)
    fitter.first()
    if fitter.count < MIN_TAG_CORNERS:
        return None
    # Missed corners are added before the others are fitted again; those that only better corners predict, afterwards.
    fitter.again()
    fitter.completed()
    fitter.without_outliers()
    if fitter.count < MIN_TAG_CORNERS:
        return None
    state, factor = fitter.last()
    row, column = np.nonzero(state.known)
    grid = np.stack([column, row], axis=-1)
    return BoardDetection(
        tags.board.board_id, *tags.board.size, grid, state.pixels[row, column], factor * state.sigma_px[row, column]
    )


@functools.cache
def _rules(border: float, mirrored: bool, rounded: bool) -> TagCornerRules:
    """Return the rules of the fit; `border` in sides of a tag, the others as for `edge_rules`."""
    return TagCornerRules.of(
        first=edge_rules(*FIRST_PASS, False, rounded),
        last=edge_rules(*LAST_PASS, mirrored, rounded),
        rough=edge_rules(*LAST_PASS, False, rounded),
        window=TagWindow.of(border=border, blurs=MARKER_BLURS, nothing_near=NOTHING_NEAR_PX),
        points_a_term=POINTS_A_TERM,
        max_leverage=MAX_LEVERAGE,
        nearest_depth=NEAREST_DEPTH,
        hardly_more=HARDLY_MORE,
        median_of_rayleigh=MEDIAN_OF_RAYLEIGH,
        first_blur=FIRST_BLUR,
        few_corners=FEW_CORNERS,
        min_contrast=MIN_EDGE_CONTRAST,
        rough_px=ROUGH_PX,
        better_known=BETTER_KNOWN,
        bent_sigmas=CURVED_SIGMAS,
        wide_blur=WIDE_BLUR,
        max_gain=MAX_PREDICTED_GAIN,
        margin_px=MARGIN_PX,
        moved_cells=MOVED_CELLS,
        added_contrast=MIN_ADDED_CONTRAST,
        added_residual=MAX_ADDED_RESIDUAL_MARKED,
        max_sigma_cells=MAX_SIGMA_CELLS,
        narrow_blurs=NARROW_BLURS,
        code_contrast=MIN_CODE_CONTRAST,
        likeness=MIN_PREDICTED_LIKENESS,
        scatter_floor=SCATTER_FLOOR_PX,
        outlier=TAG_OUTLIER,
        judging_gain=OUTLIER_TEST_GAIN,
        displaced_cells=DISPLACED_CELLS,
        min_predicting=MIN_PREDICTING_CORNERS,
        min_guiding=MIN_GUIDE_CORNERS,
    )


class _Fitter:
    """The fit of one board's corners in one image, from approximate `pixels` (R, C, 2)."""

    def __init__(self, image: GreyImage, tags: TagBoard, pixels: FloatArray, camera: Camera | None) -> None:
        self.image, self.tags, self.camera = image, tags, camera
        joined = tags.pattern.corner_squares
        rules = _rules(tags.pattern.border / tags.codes.modules, joined, image.dtype == np.uint8)
        self.fit = TagBoardFit(image, tags.packed, rules, pixels)
        # A camera's map is valid for one state only; a map through the corners is updated by the kernel itself.
        self.rounds = MAX_TAG_ROUNDS if camera is None else 1

    @property
    def state(self) -> BoardState:
        values = self.fit.corners.T.reshape(CORNER_COLUMNS, *self.tags.signs.shape)
        return BoardState(np.moveaxis(values[:2], 0, 2), *values[2:], signs=self.tags.signs)

    @property
    def count(self) -> int:
        """Number of known corners."""
        return int(np.count_nonzero(~np.isnan(self.fit.corners[:, 0])))

    def base(self, state: BoardState) -> Callable[[FloatArray], TagSurface] | None:
        """Return the camera's map of the board, with its pose from the known corners; None if there is none."""
        if self.camera is None or np.count_nonzero(state.known) < MIN_GUIDE_CORNERS:
            return None
        pose = Guide.of(self.tags.board, self.camera, state).cam_from_board
        return None if pose is None else partial(seen_surface, self.camera, pose, np.array(self.tags.board.squares_mm))

    def guide(self) -> None:
        """Pass the camera's map to the fit, if there is a camera and the corners have changed."""
        if self.camera is not None and not self.fit.mapped:
            base = self.base(self.state)
            self.fit.set_base(None if base is None else base(self.tags.places.reshape(-1, 2)).rows)

    def map_of(self, state: BoardState) -> SmoothMap:
        """Return the map through the known corners of a state."""
        known = state.known
        return SmoothMap(rows_where(self.tags.places, known), rows_where(state.pixels, known), self.base(state))

    def first(self) -> None:
        """Fit the approximate corners, drop those that fail, and add missing ones that these predict."""
        self.guide()
        self.fit.fit_all()
        if self.fit.add(1, by_this_map=True):
            self.completed()

    def completed(self) -> None:
        """Add the missing corners that are visible, each round predicted by the corners of the previous one."""
        for _ in range(0, MAX_TAG_ROUNDS, self.rounds):
            self.guide()
            if not self.fit.add(self.rounds):
                break

    def again(self) -> None:
        """Fit those corners again for which a better estimate of the curvature of their lines is known now."""
        self.guide()
        self.fit.fit_bent()

    def without_outliers(self) -> None:
        """Drop corners that contradict their neighbours."""
        for _ in range(0, MAX_TAG_ROUNDS, self.rounds):
            self.guide()
            if not self.fit.drop(self.rounds):
                break

    def last(self) -> tuple[BoardState, float]:
        """Return the final corners and the factor of their sigmas."""
        joined = self.tags.pattern.corner_squares
        factor = self.fit.sigma_factor(factor_rules(LAST_PASS[0])) if joined else 1.0
        state = self.state
        for rules in WHOLE_ROUNDS:
            whole = with_whole_tags(self.image, self.tags, self.tags.places, state, partial(self.map_of, state), rules)
            if whole is state:
                break
            state = whole
            self.fit.put(*(getattr(state, name) for name in FITTED))
        if self.count >= MIN_GUIDE_CORNERS:
            self.guide()
            scatter = self.fit.scatter(factor) / MEDIAN_OF_RAYLEIGH
            factor *= scatter if scatter > UNEXPLAINED_SCATTER else 1.0
        return state, factor
