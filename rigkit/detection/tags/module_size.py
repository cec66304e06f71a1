"""How large the modules of tags are, and with them how wide tags were printed, whatever light and ink have done to
their edges.

Too much light lets bright parts run over into dark ones, ink that spreads dark ones into bright ones: tags seem smaller
or larger than they are, and the gaps between them larger or smaller. The bits of a code grow and shrink around their
middles, and tags around theirs, so that these tell the size of a module, and how far edges have moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.tags.codes import transferred
from rigkit.kernels.surface import maps_of_quads

SAMPLES, STRIDE = 8, 2
"""Parts of a module along each of its sides by which edges are moved, and from one to the next of those that are looked
at."""

ENOUGH_TAGS = 12
"""Tags, evenly spread over those seen, that are looked at: what more of them say is the same."""

OUTLINE_STEP = 0.5
"""Widths of tags that are tried, modules: between them likeness is a parabola."""

EDGE_MOVES = np.arange(-4, 5) / SAMPLES
"""By how much edges may have moved into what is dark, modules: at half a module a lone bit is gone."""


@dataclass(frozen=True, slots=True)
class ModuleSize:
    """What the codes of tags that lie beside each other say of their print, in modules.

    Attributes
    ----------
    outline : the side of the quadrilaterals that were taken for the tags.
    moved : how far bright parts have run over into dark ones; negative where dark ones have into bright ones.
    side : a tag's, where its edges were printed.
    squares : there are dark squares between the corners of tags.
    """

    outline: float
    moved: float
    side: float
    squares: bool


def module_size(image: GreyImage, upright: FloatArray, bits: BoolArray, step: float) -> ModuleSize | None:
    """Return how large the modules of tags are, from all of them together; None where their codes do not say.

    Parameters
    ----------
    upright : (N, 4, 2) corners of what was taken for the tags, as it turned out to stand upright.
    bits : (N, B, B) which bits of their codes are black.
    step : from one tag to the next, in sides of these quadrilaterals.
    """
    some = slice(None, None, -(-len(upright) // ENOUGH_TAGS))
    upright, bits, count = upright[some], bits[some], bits.shape[1]
    maps = maps_of_quads(upright)
    outlines = np.arange(count + 1.0, count + 6.0, OUTLINE_STEP)
    # From the middle of the first bit to that of the last: beyond, edges move to one side only.
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
    """Return the brightness of codes (N, B, B) where it is looked at, with edges moved: (D, N, K)."""
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
    """Return rows (..., K) of mean 0 and length 1, 0 where all is the same."""
    out = levels - levels.mean(axis=-1, keepdims=True)
    length = np.linalg.norm(out, axis=-1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, out / np.maximum(length, 1e-9), 0.0), np.float64)


def _peak(values: FloatArray, at: int) -> float:
    """Return where the parabola through the largest of `values` and those beside it has its peak."""
    if not 0 < at < len(values) - 1:
        return float(at)
    before, here, after = values[at - 1 : at + 2]
    bend = before - 2.0 * here + after
    return float(at + (0.5 * (before - after) / bend if bend < 0.0 else 0.0))


def _edges(image: GreyImage, maps: FloatArray, outline: float, count: int, pitch: float) -> tuple[float, bool] | None:
    """Return the side of tags as their edges are seen, in modules, and whether there are dark squares between them;
    None where no edge is seen between the codes.

    `outline` is the side of what `maps` (N, 3, 3) take the unit square to, `pitch` the way from tag to tag.
    """
    # From the end of a code to the middle of the gap, along lines through all of its bits.
    out = np.arange(0.5 * count, 0.5 * pitch + 0.5 / SAMPLES, 1.0 / SAMPLES)
    line = np.arange(count) - 0.5 * (count - 1)
    right = np.stack(np.broadcast_arrays(out[:, None], line), axis=-1)
    neighbours = np.stack([right, -right, right[..., ::-1], -right[..., ::-1]])
    seen = sample(image, transferred(maps, 0.5 + neighbours.reshape(-1, 2) / outline))
    levels = np.median(seen.reshape(len(maps), 4, len(out), count), axis=(0, 1, 3))
    half = 0.5 * (levels.min() + levels[-1])
    # The border is darkest; from there on it is sought where the gap begins.
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
