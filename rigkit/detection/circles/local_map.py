"""The map from the plane of a lattice to the image around each of its circles: a polynomial through its neighbours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.circles.blobs import scaled_up
from rigkit.detection.tags.surface import SmoothMap, wide_perspective
from rigkit.kernels import circles as kernel
from rigkit.kernels.circles import BESIDE

SQUARE_BASIS = np.eye(2)
HEXAGONAL_BASIS = np.array([[1.0, 0.5], [0.0, np.sqrt(0.75)]])
"""Steps of a lattice in its plane, in distances of neighbours, as columns."""

MAP_REACH = 3.1
"""Distance within which neighbours are used: 36 in a hexagonal lattice, 28 in a square one."""
NEXT = 1.1
"""A distance between those of the nearest and the second nearest neighbours."""
MAP_WIDTH = 1.6
"""Standard deviation of their Gaussian weight, in distances of neighbours."""
TYPICAL_DERIVATIVES = (np.inf, np.inf, 0.3, 0.1, 0.03)
"""Prior standard deviations of derivatives of order 0 to 4, in distances of neighbours: each is a third of the one
before if lens or slant bends the lattice as strongly as its circles can still be linked. They limit the effect of the
scatter of few neighbours."""
CLIPPED = 4.0
"""Half axes further from the typical one count as this many median absolute deviations off: a smear or a lamp on one
circle would turn the line through all."""
SPREAD_PX, MIN_SCATTER_PX = 0.5, 1e-3
"""Prior standard deviation of the px by which the edges of all circles are moved alike, and smallest standard deviation
of half axes. They matter only where all circles are as large, and then the centre hardly depends on them."""
MIN_RIDGE = 1e-9
"""Smallest regularisation, for fewer neighbours than terms."""
SLIGHT = 1e-4
"""Regularisation of a homography's perspective terms, relative to the weight of its neighbours, which may be few."""
MIN_SMOOTH, MIXED_STEP = 20, 0.3
"""Smallest number of circles for a map of the whole board, and half the step of its mixed derivative."""
MIN_BELOW = 0.1
"""Smallest divisor of a homography, which is 0 at the horizon: near it nothing can be predicted."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PlaneMap:
    """The map from the plane (in distances of neighbours) to the image around M places.

    Attributes
    ----------
    pixels : (M, 2) of the places.
    first : (M, 2, 2) derivatives with respect to the plane's x and y, as columns.
    second : (M, 2, 3) second derivatives, xx, xy and yy.
    support : (M,) number of circles used, without the one at the place itself.
    surrounded : (M,) whether there is a circle on every side.
    gain, slope_gain : (M,) standard deviation of `pixels`, and of `first` (per distance; the mean over both sides), for
        circles of standard deviation 1.
    """

    pixels: FloatArray
    first: FloatArray
    second: FloatArray
    support: IntArray
    surrounded: BoolArray
    gain: FloatArray
    slope_gain: FloatArray

    def enlarged(self, scale: int) -> PlaneMap:
        """Return the map in an image that is `scale` times as large."""
        return replace(self, pixels=scaled_up(self.pixels, scale), first=scale * self.first, second=scale * self.second)


class Radii(NamedTuple):
    """The radius of a board's circles in distances of neighbours: as their edges are `seen`, and as they are `printed`.

    A tone curve, saturation and ink move all edges by the same number of px. The image of the centre follows from the
    printed circle, the rim of a larger one curves more.
    """

    seen: float
    printed: float

    @classmethod
    def of(cls, maps: FloatArray, around: PlaneMap, *, moved: bool = False) -> Radii:
        """Return the radii of circles with `maps` (N, 2, 2), px per radius.

        The printed one is the slope of the line through the half axes over the distances of neighbours, both in px:
        slanted and distant circles have small ones. It is not told from the other if the camera `moved`: edges are then
        moved by different amounts along the motion and across.
        """
        with np.errstate(all="ignore"):
            seen = float(np.nanmedian(np.sqrt(np.abs(np.linalg.det(maps) / np.linalg.det(around.first)))))
        # Clutter has lattices without area; the products of infinity and zero would be warned of.
        seen = seen if np.isfinite(seen) else np.nan
        used = around.surrounded & np.isfinite(around.first).all(axis=(1, 2)) & np.isfinite(maps).all(axis=(1, 2))
        if moved or not used.any() or np.isnan(seen):
            return cls(seen, seen)
        directions, distance_px, _ = np.linalg.svd(around.first[used])
        half_px = np.linalg.norm(np.swapaxes(maps[used], 1, 2) @ directions, axis=1)
        distance, off_px = distance_px.ravel(), half_px.ravel() - seen * distance_px.ravel()
        terms = np.stack([distance, np.ones_like(distance)], axis=1)
        typical_px = float(np.median(off_px))
        scatter_px = MIN_SCATTER_PX + float(np.median(np.abs(off_px - typical_px)))
        off_px = np.clip(off_px, typical_px - CLIPPED * scatter_px, typical_px + CLIPPED * scatter_px)
        # The distances come from maps that share their circles, and with them their errors: they count as one.
        ridge = float(np.mean(around.support[used])) * (scatter_px / SPREAD_PX) ** 2
        more, _ = np.linalg.solve(terms.T @ terms + np.diag([0.0, ridge]), terms.T @ off_px)
        return cls(seen, seen + float(more))


CORNER = {False: np.sqrt(2.0), True: np.sqrt(4.0 / 3.0)}
"""Ratio of the distances of a cell's corners and sides from its circle, in a square and in a hexagonal lattice."""


def plane_basis(hexagonal: bool) -> FloatArray:
    return HEXAGONAL_BASIS if hexagonal else SQUARE_BASIS


def beside_each(label: IntArray, hexagonal: bool) -> IntArray:
    """Return the indices (N, BESIDE) of the neighbours of each circle, -1 for none."""
    low = label.min(axis=0) - 1
    table = np.full(np.ptp(label, axis=0) + 3, -1)
    table[tuple((label - low).T)] = np.arange(len(label))
    around = table[tuple((label[:, None] + steps(hexagonal) - low).transpose(2, 0, 1))]
    return np.pad(around, ((0, 0), (0, BESIDE - around.shape[1])), constant_values=-1)


def steps(hexagonal: bool) -> IntArray:
    """Return the steps to a circle's neighbours, (4, 2) or (6, 2)."""
    return np.array([(1, 0), (-1, 0), (0, 1), (0, -1), *([(1, -1), (-1, 1)] if hexagonal else [])])


def local_maps(
    label: IntArray, pixels: FloatArray, places: IntArray, *, hexagonal: bool, sigma_px: float, leave_out: bool = False
) -> PlaneMap:
    """Return the maps around `places` (M, 2) of a lattice, from its circles at `label` (N, 2) and `pixels` (N, 2).

    `sigma_px`: standard deviation of the circles. `leave_out`: without the circles at the places themselves.
    """
    step = plane_basis(hexagonal)
    side = int(np.ceil(MAP_REACH * 1.2)) + 1
    offset = np.stack(np.meshgrid(np.arange(-side, side + 1), np.arange(-side, side + 1)), axis=-1).reshape(-1, 2)
    plane = offset @ step.T
    distance = np.hypot(*plane.T)
    near = distance < MAP_REACH
    offset, plane, distance = offset[near], plane[near], distance[near]
    low = np.minimum(label.min(axis=0), places.min(axis=0)) - side
    size = np.maximum(label.max(axis=0), places.max(axis=0)) + side + 1 - low
    table = np.full((*size, 2), np.nan)
    table[tuple((label - low).T)] = pixels
    # One for each term x^i y^j of the polynomial, order by order.
    typical = np.repeat(TYPICAL_DERIVATIVES, np.arange(1, len(TYPICAL_DERIVATIVES) + 1))
    weights = np.exp(-0.5 * distance**2 / MAP_WIDTH**2)
    rules = kernel.PredictionRules.of(
        sigma_px=sigma_px, min_ridge=MIN_RIDGE, slight=SLIGHT, min_below=MIN_BELOW, leave_out=int(leave_out)
    )
    rows = kernel.local_maps(table, places - low, offset, plane, weights, distance < NEXT, typical, rules)
    return PlaneMap(
        pixels=rows[:, :2],
        first=rows[:, 2:6].reshape(-1, 2, 2),
        second=rows[:, 6:12].reshape(-1, 2, 3),
        support=rows[:, 12].astype(np.int64),
        surrounded=rows[:, 13] > 0.0,
        gain=rows[:, 14],
        slope_gain=rows[:, 15],
    )


def with_smooth_curvatures(
    around: PlaneMap, label: IntArray, pixels: FloatArray, size_px: tuple[int, int], *, hexagonal: bool
) -> PlaneMap:
    """Return the map `around` the circles of a lattice, (N, 2) each, with second derivatives of one map through all.

    At the rim neighbours are on one side only, and curvatures from them are inaccurate. A smooth map of the board is
    more accurate: a perspective through a lens in the middle of an image of `size_px`, plus a polynomial. The map is
    returned unchanged if there are few circles.
    """
    if len(label) < MIN_SMOOTH:
        return around
    places = label @ plane_basis(hexagonal).T
    centre = 0.5 * (np.array(size_px) - 1.0)
    smooth = SmoothMap(places, pixels, wide_perspective(places, pixels, centre))
    here, below, above = (smooth.at(places + np.array([0.0, off])) for off in (0.0, MIXED_STEP, -MIXED_STEP))
    mixed = (below.sides[:, 0] - above.sides[:, 0]) / (2.0 * MIXED_STEP)
    second = np.stack([here.curvatures[:, 0], mixed, here.curvatures[:, 1]], axis=2)
    known = np.isfinite(second).all(axis=(1, 2), keepdims=True)
    return replace(around, second=np.where(known, second, around.second))
