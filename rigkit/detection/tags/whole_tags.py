"""The fit of whole tags, for tags with a border too narrow for the windows of single corners.

An edge spreads two standard deviations of the blur to either side. If a tag's border is narrower than four of them, all
pixels near its corners are affected by the code. But the code and the surroundings of the tag are known: the model is
the image of all of it, with the four corners as parameters. The curvature of the map between them comes from the
corners of the other tags. If some of the four corners are missing, the fit starts from their predictions by other tags,
and gives the visible ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.detection.guided.board_guide import BoardState
from rigkit.detection.guided.corner_fit import MARKER_BLURS
from rigkit.detection.guided.guided import MARGIN_PX, MAX_ADDED_RESIDUAL
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.subpixel.edge_fit import (
    BLUR_RANGE,
    LIGHT_SIGMA_PER_PX,
    MAX_BLUR_CHANGE,
    MAX_MOVE_PX,
    ROUNDING_VARIANCE,
    VALID_MOVE_CELLS,
    VALID_MOVE_PX,
)
from rigkit.detection.subpixel.edge_model import PIXEL_KURTOSIS, SHARP_BLUR_PX
from rigkit.detection.subpixel.subpixel import LAST_PASS
from rigkit.detection.subpixel.whole_board import PICTURE_SIGMAS
from rigkit.detection.tags.placing import TagBoard
from rigkit.detection.tags.surface import SmoothMap
from rigkit.kernels.tag_board import tag_heights
from rigkit.kernels.tags import TagRules, TagsToFit, fit_tags

NARROW_BLURS = 2.0 * MARKER_BLURS
"""Width of a border, in s, below which the windows of all its corners contain the code. On real images of a grid,
reduced and blurred until borders were 3.3 s wide, held-out errors decrease from 0.097 to 0.079 px; at 3.7 s they are
0.097 px in both cases. Wider ones are better fitted by corner (0.19 px; 0.24 px as a whole): printed modules and
saturated paper do not follow the model to a pixel."""

CURVATURE_SIGMAS = 0.3
"""Standard deviation of the middles of a tag's sides relative to its corners, in their sigmas: the curvature comes from
three tags or more; a second difference has sqrt(6) of their sigma, and the sagitta is an eighth of it."""

MIN_SADDLE = 0.5
"""Smallest contrast of a square's and a tag's ink to the gaps between them at a corner that was not found by itself,
over that at those found: 1 where it is visible, 0 or less under a cover."""

ROUGH_STEP_PX = 0.1
"""Last step of a round after which tags are fitted again: the remaining error is a tenth of it."""

MAX_TAKEN = 0.02
"""Largest relative decrease of the sum of squares by the last step, for sigmas to a hundredth: initially the light is
unknown, and if it was fitted one step after the corners, sigmas were up to four times too large."""


def _rules(converged_px: float) -> TagRules:
    return TagRules.of(
        tail_sigmas=PICTURE_SIGMAS,
        pixel_kurtosis=PIXEL_KURTOSIS,
        sharp_blur=SHARP_BLUR_PX,
        min_blur=BLUR_RANGE[0],
        max_blur=BLUR_RANGE[1],
        max_move_px=MAX_MOVE_PX,
        max_blur_change=MAX_BLUR_CHANGE,
        light_sigma=LIGHT_SIGMA_PER_PX,
        min_variance=ROUNDING_VARIANCE,
        converged_px=converged_px,
        max_taken=MAX_TAKEN,
        iterations=LAST_PASS[1],
    )


WHOLE_ROUNDS = (_rules(ROUGH_STEP_PX), WHOLE_RULES := _rules(LAST_PASS[2]))
"""Whole tags are fitted a second time with the map through the improved corners."""

PAPER_STEP = 2.0
"""Difference of paper and ink, in contrasts of the fit of a lone square's corner."""

TAG_CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
"""Corners of a tag in the order of the lattice, row by row."""

MAP_NODES = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 5)] * 2), axis=-1).reshape(-1, 2)
"""Points of a tag at which its map is evaluated: none outside, where a polynomial through all corners may diverge."""


def with_whole_tags(
    image: GreyImage,
    tags: TagBoard,
    places: FloatArray,
    state: BoardState,
    map_of_state: Callable[[], SmoothMap],
    rules: TagRules,
) -> BoardState:
    """Return the state with the corners of tags of narrow borders replaced by those of the fits of whole tags.

    `places` (R, C, 2) of the corners, in sides of a tag; `map_of_state` returns the map through the corners of `state`.
    """
    # The blur of single corners is not reliable if the code is in their windows.
    blur = known_median(state.blur)
    border = tags.pattern.border / tags.codes.modules
    # Where there are squares between tags, windows end half way to their other corners.
    thinnest = min(border, tags.pattern.spacing) if tags.pattern.corner_squares else border
    narrowest = NARROW_BLURS * blur / thinnest
    if not (tag_heights(state.pixels)[1] < narrowest).any():
        return state
    smooth = map_of_state()
    filled, partly = _predicted(state, smooth.at(places.reshape(-1, 2)).pixels.reshape(places.shape), image.shape)
    longer, height = tag_heights(filled)
    narrow = height < narrowest
    row, column = (2 * part for part in np.nonzero(narrow))
    mine = row[:, None] + TAG_CORNERS[:, 1], column[:, None] + TAG_CORNERS[:, 0]
    corners = filled[mine]
    maps, centres, scales = _maps(places[row, column], corners, smooth)
    ink, breaks = _ink(tags)
    step = 1.0 if tags.pattern.corner_squares else PAPER_STEP
    start = TagsToFit(
        maps=maps,
        centres=centres,
        scales=scales,
        ink=ink[row // 2, column // 2],
        breaks=breaks,
        reach=0.5 * tags.pattern.spacing,
        blur=np.full(len(row), blur),
        contrast=step * np.nanmean(state.contrast[mine], axis=1),
        curvature_sigma=CURVATURE_SIGMAS * np.maximum(np.nanmedian(state.sigma_px[mine], axis=1), smooth.scatter()),
    )
    found = fit_tags(image, start, rules)
    moves = found[:, :8].reshape(-1, 4, 2)
    good = np.sqrt((moves**2).sum(axis=2)).max(axis=1) < np.maximum(VALID_MOVE_CELLS * longer[narrow], VALID_MOVE_PX)
    good &= (found[:, 15] > 0.5) & (found[:, 13] > 0.0)
    residual = found[:, 14] / np.maximum(found[:, 13], 1e-9)
    complete = ~partly[narrow]
    good &= complete | (residual < MAX_ADDED_RESIDUAL * known_median(residual[complete & good]))
    pixels, sigma_px, blurs, contrast = (
        part.copy() for part in (state.pixels, state.sigma_px, state.blur, state.contrast)
    )
    better = mine[0][good], mine[1][good]
    pixels[better], sigma_px[better] = corners[good] + moves[good], found[good, 8:12]
    blurs[better], contrast[better] = found[good, 12:13], found[good, 13:14] / step
    # A predicted corner that was not found by itself is not reported, unless narrow gaps are the cause.
    known = state.known
    seen = known | _saddles(image, tags, places, smooth, known) if thinnest < border else known
    for values in (pixels, sigma_px, blurs, contrast):
        values[~seen] = np.nan
    return replace(state, pixels=pixels, sigma_px=sigma_px, blur=blurs, contrast=contrast)


def _saddles(image: GreyImage, tags: TagBoard, places: FloatArray, smooth: SmoothMap, known: BoolArray) -> BoolArray:
    """Return which corners (R, C) have a tag and a square on one diagonal and gaps on the other, as clearly as those
    known have."""
    around = 0.5 * tags.pattern.spacing * np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]])
    pixels = smooth.at((places[..., None, :] + around).reshape(-1, 2)).pixels.reshape(*places.shape[:2], 4, 2)
    inside = np.asarray(((pixels > 0.0) & (pixels < np.array(image.shape[::-1]) - 1.0)).all(axis=(2, 3)))
    level = sample(image, np.where(inside[..., None, None], pixels, 0.0)).astype(np.float64)
    one, other = level[..., :2], level[..., 2:]
    # From the first corner of a tag the first diagonal leads into it.
    into = np.add.outer(np.arange(known.shape[0]), np.arange(known.shape[1]))[..., None] % 2 == 0
    saddle = np.where(into, other, one).min(axis=2) - np.where(into, one, other).max(axis=2)
    clear: BoolArray = saddle > MIN_SADDLE * known_median(np.where(known & inside, saddle, np.nan))
    return inside & clear


def _predicted(state: BoardState, predicted: FloatArray, shape: tuple[int, ...]) -> tuple[FloatArray, BoolArray]:
    """Return the corners (R, C, 2), filled with those `predicted` of partly known tags that are inside the image, and
    which tags (R / 2, C / 2) these are."""
    inside = ((predicted > MARGIN_PX) & (predicted < np.array(shape[::-1]) - 1.0 - MARGIN_PX)).all(axis=2)
    known = state.known
    some, every, fits = (
        how(part.reshape(known.shape[0] // 2, 2, -1, 2), axis=(1, 3))
        for how, part in ((np.any, known), (np.all, known), (np.all, known | inside))
    )
    partly = some & ~every & fits
    wanted = ~known & np.repeat(np.repeat(partly, 2, axis=0), 2, axis=1)
    return np.where(wanted[..., None], predicted, state.pixels), partly


def _maps(first: FloatArray, corners: FloatArray, smooth: SmoothMap) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the maps from the image to N tags, their centres and scales, as for `kernels.tags.TagsToFit`.

    `first` (N, 2) are the places of the tags' first corners on the board, `corners` (N, 4, 2) the pixels of all.
    """
    every = np.concatenate([MAP_NODES, TAG_CORNERS])
    seen = smooth.at((first[:, None] + every).reshape(-1, 2)).pixels.reshape(len(first), -1, 2)
    x, y = MAP_NODES[:, :1], MAP_NODES[:, 1:]
    share = np.concatenate([(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y], axis=1)
    seen = seen[:, : len(MAP_NODES)] + share @ (corners - seen[:, len(MAP_NODES) :])
    centres = seen.mean(axis=1)
    off = seen - centres[:, None]
    scales = np.abs(off).max(axis=(1, 2))
    u, v = np.moveaxis(off / scales[:, None, None], 2, 0)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=2)
    turned = terms.transpose(0, 2, 1)
    return np.linalg.solve(turned @ terms, turned @ MAP_NODES).transpose(0, 2, 1), centres, scales


def _ink(tags: TagBoard) -> tuple[BoolArray, FloatArray]:
    """Return which cells in and around each tag are dark, (R / 2, C / 2, M + 4, M + 4), and the limits between cells.

    Around the M x M modules these are the gap to the next tags and, beyond, their borders.
    """
    pattern, numbers = tags.pattern, tags.numbers
    modules = pattern.modules()[numbers]
    side = modules.shape[2]
    ink = np.zeros((*numbers.shape, side + 4, side + 4), np.bool_)
    ink[:, :, 2:-2, 2:-2] = modules
    spans = {-1: slice(0, 1), 0: slice(2, -2), 1: slice(-1, None)}
    there = np.zeros((numbers.shape[0] + 2, numbers.shape[1] + 2), np.bool_)
    there[1:-1, 1:-1] = True
    for down, right in ((a, b) for a in spans for b in spans if a or b):
        beside = there[1 + down : there.shape[0] - 1 + down, 1 + right : there.shape[1] - 1 + right]
        ink[:, :, spans[down], spans[right]] = beside[:, :, None, None]
    if pattern.corner_squares:
        ink[:, :, [1, 1, -2, -2], [1, -2, 1, -2]] = True
    breaks = np.concatenate([[-pattern.spacing], np.arange(side + 1) / side, [1.0 + pattern.spacing]])
    return ink, breaks
