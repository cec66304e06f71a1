"""The size of the modules of tags, and with it the printed size of the tags, if light or ink has moved their edges.

Too much light spreads bright parts into dark ones, and ink dark parts into bright ones: tags seem smaller or larger
than they are, and the gaps between them larger or smaller. The bits of a code and the tags grow or shrink around their
own middles. The middles give the size of a module and the displacement of edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, sampling_step
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.tags.codes import transferred
from rigkit.kernels.surface import maps_of_quads

SAMPLES, STRIDE = 8, 2
"""Samples of a module along each of its sides, by which edges are moved, and the step between the samples that are
compared."""

ENOUGH_TAGS = 12
"""Largest number of tags that are evaluated, evenly spread over those found: more of them change nothing."""

OUTLINE_STEP = 0.5
"""Step between the sides of tags that are tried, in modules: in between, the correlation is a parabola."""

EDGE_MOVES = np.arange(-4, 5) / SAMPLES
"""Displacements of edges into dark parts that are tried, in modules: at half a module a single bit vanishes."""


@dataclass(frozen=True, slots=True)
class ModuleSize:
    """Size of adjacent tags as printed, from their codes, in modules.

    Attributes
    ----------
    outline : side of the given quadrilaterals.
    moved : displacement of edges into dark parts; negative if dark parts have spread into bright ones.
    side : printed side of a tag.
    squares : whether there are dark squares between the corners of tags.
    """

    outline: float
    moved: float
    side: float
    squares: bool


def module_size(image: GreyImage, upright: FloatArray, bits: BoolArray, step: float) -> ModuleSize | None:
    """Return the size of the modules of all tags together; None if no edge of the tags is visible.

    Parameters
    ----------
    upright : (N, 4, 2) quadrilaterals of the tags, from the upright tag's first corner.
    bits : (N, B, B) which bits of their codes are black.
    step : distance from one tag to the next, in sides of these quadrilaterals.
    """
    some = slice(None, None, sampling_step(len(upright), ENOUGH_TAGS))
    upright, bits, count = upright[some], bits[some], bits.shape[1]
    maps = maps_of_quads(upright)
    outlines = np.arange(count + 1.0, count + 6.0, OUTLINE_STEP)
    # From the middle of the first bit to that of the last one: beyond, edges move in one direction only.
    along = (np.arange(0, SAMPLES * (count - 1), STRIDE) + 0.5) / SAMPLES - 0.5 * (count - 1)
    places = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    models = _normal(_codes(bits))
    likeness = np.zeros((len(outlines), len(EDGE_MOVES)))
    for k, outline in enumerate(outlines):
        seen = _normal(sample(image, transferred(maps, 0.5 + places / outline)).astype(np.float64))
        likeness[k] = np.einsum("ns,dns->d", seen, models)
    at, way = np.unravel_index(likeness.argmax(), likeness.shape)
    outline = outlines[0] + OUTLINE_STEP * _peak(likeness[:, way], int(at))
    moved = EDGE_MOVES[0] + _peak(likeness[at], int(way)) / SAMPLES
    edges = _edges(image, maps, outline, count, step * outline)
    if edges is None:
        return None
    side, squares = edges
    return ModuleSize(float(outline), float(moved), float(side + 2.0 * moved), squares)


def _codes(bits: BoolArray) -> FloatArray:
    """Return the brightness (D, N, K) of codes (N, B, B) at the compared samples, for D displacements of edges."""
    count = bits.shape[1]
    # The border around the code is dark.
    fine = np.pad(~bits, ((0, 0), (1, 1), (1, 1))).astype(np.uint8)
    fine = fine.repeat(SAMPLES, axis=1).repeat(SAMPLES, axis=2)
    first = SAMPLES + SAMPLES // 2
    part = slice(first, first + SAMPLES * (count - 1), STRIDE)
    out = []
    for moved in np.rint(EDGE_MOVES * SAMPLES).astype(int):
        window = np.ones((2 * abs(moved) + 1,) * 2, np.uint8)
        run = cv2.dilate if moved > 0 else cv2.erode
        out.append(np.stack([run(one, window)[part, part] for one in fine]))
    return np.array(out, np.float64).reshape(len(EDGE_MOVES), len(bits), -1)


def _normal(levels: FloatArray) -> FloatArray:
    """Return rows (..., K) of mean 0 and length 1, or 0 if constant."""
    out = levels - levels.mean(axis=-1, keepdims=True)
    length = np.linalg.norm(out, axis=-1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, out / np.maximum(length, 1e-9), 0.0), np.float64)


def _peak(values: FloatArray, at: int) -> float:
    """Return the peak of the parabola through the largest value, at index `at`, and its neighbours."""
    if not 0 < at < len(values) - 1:
        return float(at)
    before, here, after = values[at - 1 : at + 2]
    bend = before - 2.0 * here + after
    return float(at + (0.5 * (before - after) / bend if bend < 0.0 else 0.0))


def _edges(image: GreyImage, maps: FloatArray, outline: float, count: int, pitch: float) -> tuple[float, bool] | None:
    """Return the visible side of tags, in modules, and whether there are dark squares between them; None if no edge is
    visible between the codes.

    `maps` (N, 3, 3) map the unit square to quadrilaterals of side `outline`; `pitch` is the distance from tag to tag.
    """
    # From the end of a code to the middle of the gap, along lines through all of its bits.
    out = np.arange(0.5 * count, 0.5 * pitch + 0.5 / SAMPLES, 1.0 / SAMPLES)
    line = np.arange(count) - 0.5 * (count - 1)
    right = np.stack(np.broadcast_arrays(out[:, None], line), axis=-1)
    neighbours = np.stack([right, -right, right[..., ::-1], -right[..., ::-1]])
    seen = sample(image, transferred(maps, 0.5 + neighbours.reshape(-1, 2) / outline))
    levels = np.median(seen.reshape(len(maps), 4, len(out), count), axis=(0, 1, 3))
    half = 0.5 * (levels.min() + levels[-1])
    # The border is darkest; from there outwards the edge is the beginning of the gap.
    darkest = int(levels.argmin())
    beyond = np.flatnonzero(levels[darkest:] >= half)
    if not len(beyond) or not darkest + beyond[0]:
        return None
    after = darkest + int(beyond[0])
    before, here = levels[after - 1 : after + 1]
    edge = out[after] - (here - half) / max(here - before, 1e-9) / SAMPLES
    corners = 0.5 * pitch * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    between = np.median(sample(image, transferred(maps, 0.5 + corners / outline)))
    return 2.0 * float(edge), bool(between < half)
