"""Tags whose border is too narrow for the windows of their corners: the whole tag is fitted at once.

An edge spreads two standard deviations of the blur to either side. Where a tag's border is narrower than four of them,
no pixel near its corners shows their two lines and nothing of the code. But then the code is known, as is what lies
around the tag: all of it is the model, and its four corners are what is sought. How the picture bends between them is
told by the corners of the other tags. Where one of the four is not seen, the others are had from the whole tag all
the same: it starts where those of other tags foretell it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.detection.guided.board_guide import BoardState
from rigkit.detection.guided.corner_fit import MARKER_BLURS
from rigkit.detection.guided.guided import MARGIN_PX, MAX_ADDED_RESIDUAL
from rigkit.detection.saddles.response import GreyImage
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
from rigkit.detection.tags.placing import TagBoard
from rigkit.detection.tags.surface import SmoothMap
from rigkit.kernels.tag_board import tag_heights
from rigkit.kernels.tags import TagRules, fit_tags

NARROW_BLURS = 2.0 * MARKER_BLURS
"""A border narrower than this, s, has the code in all windows of its corners. On real images of a grid, made
smaller and blurred until borders were 3.3 s wide, held-out errors fall from 0.097 to 0.079 px; at 3.7 s they are 0.097
px either way. Wider ones are better alone (0.19 px; 0.24 px whole): printed modules and saturated paper are no model to
a pixel."""

CURVATURE_SIGMAS = 0.3
"""The middles of a tag's sides are known beside its corners to this part of what corners are: the bend comes from those
of three tags or more, and a second difference of theirs has sqrt(6) of their sigma, the sagitta an eighth of that."""

EDGE_REACH_SIGMAS = 4.0
"""Edges further from a pixel than this, s, are nothing to it."""

ROUGH_STEP_PX = 0.1
"""A step that ends a round after which tags are fitted again: what is left after it is a tenth of it."""

MAX_TAKEN = 0.02
"""The last step takes no more than this part of the squares that are left: sigmas are right to a hundredth. The light
is not known beforehand, and one fitted a step later than the corners made sigmas up to four times too large."""


def _rules(converged_px: float) -> TagRules:
    return TagRules.of(
        tail_sigmas=EDGE_REACH_SIGMAS,
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
"""Whole tags are fitted again with the picture bent as their finer corners have it."""

PAPER_STEP = 2.0
"""The whole step from ink to paper, in the contrast that the fit of the corner of a lone square has."""

TAG_CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
"""Of a tag, as the lattice has them row by row."""

MAP_NODES = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 5)] * 2), axis=-1).reshape(-1, 2)
"""Where in a tag its map is taken: nowhere beyond its corners, where a polynomial through all of them may run wild."""


def with_whole_tags(
    image: GreyImage,
    tags: TagBoard,
    places: FloatArray,
    state: BoardState,
    map_of_state: Callable[[], SmoothMap],
    rules: TagRules,
) -> BoardState:
    """Return the state with the corners of tags of narrow borders as the whole tags have them.

    `places` (R, C, 2) of the corners, in sides of a tag; `map_of_state` makes the map through the corners of the state.
    """
    # What single corners have for blur is not to be relied on where the code is in their windows.
    blur = known_median(state.blur)
    narrowest = NARROW_BLURS * blur * tags.codes.modules / tags.pattern.border
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
    found = fit_tags(
        *(image, maps, centres, scales, ink[row // 2, column // 2], breaks, 0.5 * tags.pattern.spacing),
        *(np.full(len(row), blur), step * np.nanmean(state.contrast[mine], axis=1)),
        *(CURVATURE_SIGMAS * np.maximum(np.nanmedian(state.sigma_px[mine], axis=1), smooth.scatter()), rules),
    )
    moves = found[:, :8].reshape(-1, 4, 2)
    furthest = np.sqrt((moves**2).sum(axis=2)).max(axis=1)
    good = (found[:, 15] > 0.5) & (found[:, 13] > 0.0)
    good &= furthest < np.maximum(VALID_MOVE_CELLS * longer[narrow], VALID_MOVE_PX)
    residual = found[:, 14] / np.maximum(found[:, 13], 1e-9)
    complete = ~partly[narrow]
    good &= complete | (residual < MAX_ADDED_RESIDUAL * known_median(residual[complete & good]))
    pixels, sigma_px, blurs, contrast = (
        part.copy() for part in (state.pixels, state.sigma_px, state.blur, state.contrast)
    )
    better = mine[0][good], mine[1][good]
    pixels[better], sigma_px[better] = corners[good] + moves[good], found[good, 8:12]
    blurs[better], contrast[better] = found[good, 12:13], found[good, 13:14] / step
    # A foretold corner that nothing showed by itself is no corner found.
    for values in (pixels, sigma_px, blurs, contrast):
        values[~state.known] = np.nan
    return replace(state, pixels=pixels, sigma_px=sigma_px, blur=blurs, contrast=contrast)


def _predicted(state: BoardState, predicted: FloatArray, shape: tuple[int, ...]) -> tuple[FloatArray, BoolArray]:
    """Return the corners (R, C, 2) with those `predicted` of tags of which some are known, if the image has all four,
    and which tags (R / 2, C / 2) these are."""
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
    """Return the maps from the image to N tags, their centres and scales as `kernels.tags.fit_tags` wants them.

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
    """Return which cells of each tag and around it are dark, (R / 2, C / 2, M + 4, M + 4), and where they end.

    Beside the M x M modules these are the gap to the next tags and, beyond, their borders.
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
