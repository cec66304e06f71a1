"""Surfaces where patches say too little: semi-global matching of a sweep through the ranges, of any central cameras.

At a range every ray of image 1 is seen somewhere in image 2. Read there, image 2 is image 1 where that is the range of
the surface (R. T. Collins, "A Space-Sweep Approach to True Multi-Image Matching", CVPR 1996). Both are compared by
their census (R. Zabih and J. Woodfill, ECCV 1994), and neighbours are asked to lie on one surface along eight paths
(H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008). Levels of a sweep are
equally spaced in inverse range, so that a plane rises evenly through them; nothing is rectified.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.affine.surface import linear_gauge
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.sweep import CENSUS_BITS, swept_costs, swept_rivals, swept_surfaces
from rigkit.optim.robust_scale import SIGMA_OF_MEDIAN
from rigkit.reconstruction.growing.grow import HALF_WIDTH, GrowingView, GrownPatches
from rigkit.reconstruction.growing.surface import NodeMeasurements

SAMPLES_A_NODE = 2
"""From node to node, along either axis."""
MAX_SWEEP_LEVELS = 160
FARTHER, NEARER = 0.1, 0.5
"""Of the range of inverse ranges that grew, to either side: what is before all of it, with too little texture to grow,
seems to be anywhere else where its texture repeats."""
CURVATURE_COST = CENSUS_BITS // 6
"""Of a step to the next level, in bits of the census."""
JUMP_COST = 2 * CENSUS_BITS
"""Of any larger step, where the brightness is even; less where it changes."""
EVEN_LEVELS = 8.0
"""Grey levels from sample to sample by which a jump becomes half as dear."""
SMOOTHED = 0.4
"""Standard deviation by which the images are smoothed, in samples: finer detail than samples show disturbs."""
TABLE_SPACING = 8
"""Samples between those that are projected; in between the places are interpolated."""
SMALLEST = 60
"""Samples of a surface; smaller ones are chance."""
LARGE = 1000
"""Samples of a surface that is no chance, though no patch agrees with it. Of 820 surfaces through two images that have
nothing in common the largest has 976 (SIMULATED: 30 to 150 levels, noise and textures of falling spectra)."""
MAX_OF_SHIFTED = 0.4
"""Costs of a smaller one over those of the same surface at any other ranges. Three of those 820 have less, most 0.5 to
0.6: the cheapest of all surfaces is half as dear as others by choice alone."""
SHIFTED_LEVELS = 3
"""From which on a range is another one: blurred detail is alike over two levels."""
MAX_RESIDUAL_LEVELS = 1.0
"""By which the sweep disagrees with the grown pairs, as a standard deviation, for it to be believed elsewhere."""
UNLIT_LEVELS = 8.0
"""Grey levels where no light falls: noise and compression."""
RIVAL_RADIUS = 5.0
"""Samples: the reach of a patch."""
ALIKE_LEVELS = 10.0
"""Grey levels that brightness varies by on a surface rather than from one to the next."""
MAX_OF_RIVAL = 2.2
"""Costs of a plane over those of any other, by the share of the nodes around that lies in it: what few agree with must
explain the pixels better. The quotient tells planes that are over a pixel off from others better than either does alone
and than whether the surface ends nearby; at 2.2 as many remain as with those (REAL motorcycle and RENDERED cards)."""
MAX_FROM_WINNER_PX = 1.5
"""Along the epipolar line, from the sweep's own surface: of planes further away than 2.5 px 93 to 100 % are wrong, of
those nearer than 1 px 1 to 8 % (REAL motorcycle, RENDERED cards)."""
MIN_SWEPT_CONTRAST = 1.0
"""Grey levels, standard deviation over a patch, of what the sweep fills: half of what patches need, as many samples
agree. Even areas cost nothing at any range; with less than the noise nothing is told apart."""
SIGMA_A = 0.3
"""Of an affinity that only says that the surface is seen at all: the sweep does not measure slants."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Sweep:
    """What two images differ by at each of K levels of inverse range.

    Attributes
    ----------
    inverse : (K,), equally spaced.
    step_px : px between samples.
    pixels1, rays1, samples1 : (R, C, 2), (R, C, 3), (R, C) samples of image 1 with their rays and brightness; NaN where
        there is none.
    costs : (R, C, K or more) bits of the census.
    winners : (R, C) levels of the surface of least cost; seen : where image 2 sees it, and nothing before it.
    """

    inverse: FloatArray
    step_px: float
    pixels1: NDArray[np.float32]
    rays1: FloatArray
    samples1: NDArray[np.float32]
    costs: NDArray[np.uint8]
    winners: FloatArray
    seen: BoolArray

    def nearest(self, pixels1: Pixels) -> tuple[IntArray, IntArray]:
        """Return row and column (...) of the samples nearest to pixels (..., 2) that have one below and one beside."""
        rows, columns = self.samples1.shape
        at = np.clip(np.rint(pixels1 / self.step_px).astype(np.int64), 0, np.array([columns - 2, rows - 2]))
        return at[..., 1], at[..., 0]

    def near_winner(self, level: FloatArray, at: tuple[IntArray, IntArray], slope: FloatArray) -> BoolArray:
        """Return which levels (...) at samples (...) are beside the sweep's own surface.

        `slope` (...) is by how many px along the epipolar line a place moves with the inverse range.
        """
        spacing_px = (self.inverse[1] - self.inverse[0]) * slope
        return np.asarray(~(np.abs(level - self.winners[at]) * spacing_px > np.maximum(MAX_FROM_WINNER_PX, spacing_px)))

    def distinct(self, pixels1: Pixels, plane: FloatArray, slope: FloatArray, support: FloatArray) -> BoolArray:
        """Return which planes m . X = 1 (N, 3) explain what is seen at pixels (N, 2) better than any other does.

        `slope` (N,) is by how many px along the epipolar line a place moves with the inverse range, `support` (N,) the
        share of the nodes around that lie in the plane. Where the sweep cannot tell, another is taken for as good.
        """
        return np.asarray(self.of_rivals(pixels1, plane, slope) < MAX_OF_RIVAL * support)

    def of_rivals(self, pixels1: Pixels, plane: FloatArray, slope: FloatArray) -> FloatArray:
        """Return the costs (N,) of planes over those of any other of the same slant; arguments as of `distinct`.

        Infinite for planes away from the sweep's own surface; 1 where the sweep cannot tell.

        Notes
        -----
        Beside an edge of depth a window shows both surfaces, and the edge itself, which belongs to the near one. So the
        far one seems as near, as wide as windows reach. Samples as bright as the point are rather of its own surface
        (K.-J. Yoon and I. S. Kweon, "Adaptive Support-Weight Approach for Correspondence Search", PAMI 2006): a plane
        that is right costs these less than any other of the same slant does.
        """
        spacing = self.inverse[1] - self.inverse[0]
        row, column = at = self.nearest(pixels1)
        level, below, right = (
            (np.einsum("ni,ni->n", plane, self.rays1[row + dr, column + dc]) - self.inverse[0]) / spacing
            for dr, dc in ((0, 0), (1, 0), (0, 1))
        )
        # The census tells no surfaces apart that are less than a sample apart.
        step_levels = np.maximum(self.step_px / (slope * spacing), 1.0)
        surfaces = np.stack([level, below - level, right - level, step_levels], axis=1)
        out, beside = np.full(len(plane), np.inf), self.near_winner(level, at, slope)
        own, other = swept_rivals(
            self.costs,
            len(self.inverse),
            self.samples1,
            np.stack(at, axis=1)[beside],
            surfaces[beside],
            radius=RIVAL_RADIUS,
            alike=ALIKE_LEVELS,
        ).T
        with np.errstate(divide="ignore", invalid="ignore"):
            out[beside] = np.nan_to_num(own / other, nan=1.0)
        return out


class FilledPairs(NamedTuple):
    """Pairs with those of a sweep, and the sweep; None where it was not believed."""

    grown: GrownPatches
    sweep: Sweep | None


def filled(
    grown: GrownPatches, measured: NodeMeasurements, view1: GrowingView, view2: GrowingView, cam2_from_cam1: Rigid3
) -> FilledPairs:
    """Return the pairs with those of a sweep at nodes where none grew; as they were where it disagrees with most.

    Where it disagrees with few, beside edges of depth that windows reach over, its own take the place of these.

    The sigma of the sweep's ranges is what they are off by where both say something.
    """
    if not np.isfinite(measured.z).any():
        return FilledPairs(grown, None)
    sweep = _swept(grown, measured, view1, view2, cam2_from_cam1)
    best, around = swept_surfaces(
        sweep.costs, len(sweep.inverse), sweep.samples1, bend=CURVATURE_COST, jump=JUMP_COST, even=EVEN_LEVELS
    )
    level, good = _winners(best, around, sweep, view2, cam2_from_cam1)
    sweep = replace(sweep, winners=level, seen=good)
    good = good & (_at(_contrast(view1), sweep.pixels1) > MIN_SWEPT_CONTRAST) & (_at(_lit(view1), sweep.pixels1) == 1.0)
    spacing = sweep.inverse[1] - sweep.inverse[0]
    at_nodes = (measured.z[..., 0] - sweep.inverse[0]) / spacing
    of_grown = np.full(level.shape, np.nan)
    of_grown[::SAMPLES_A_NODE, ::SAMPLES_A_NODE] = at_nodes
    good = _reliable(sweep, good, of_grown)
    off = np.abs(level - of_grown)[good & np.isfinite(of_grown)]
    residual = SIGMA_OF_MEDIAN * float(np.median(off)) if off.size else np.inf
    if not residual < MAX_RESIDUAL_LEVELS:
        return FilledPairs(grown, None)
    at = sweep.nearest(grown.pixels1)
    grown = grown.where(grown.valid & (sweep.near_winner(at_nodes, at, measured.slope) | ~good[at]))
    inverse = np.where(good, sweep.inverse[0] + spacing * level, np.nan)[::SAMPLES_A_NODE, ::SAMPLES_A_NODE]
    return FilledPairs(_with(grown, inverse, residual * spacing, view1, view2, cam2_from_cam1), sweep)


def _swept(
    grown: GrownPatches, measured: NodeMeasurements, view1: GrowingView, view2: GrowingView, cam2_from_cam1: Rigid3
) -> Sweep:
    inverse = measured.z[..., 0]
    low, high = np.nanquantile(inverse, [0.001, 0.999])
    pixel = 1.0 / float(np.nanquantile(measured.slope, 0.9))
    # A wall that faces the camera is all at one range.
    farther, nearer = (max(share * (high - low), 2.0 * pixel) for share in (FARTHER, NEARER))
    low, high = max(low - farther, 0.0), high + nearer
    count = int(np.clip(np.ceil((high - low) / pixel) + 1, 3, MAX_SWEEP_LEVELS))
    levels = np.linspace(low, high, count)
    step = grown.step / SAMPLES_A_NODE
    width, height = view1.size_px
    shape = int((height - 1) // step) + 1, int((width - 1) // step) + 1
    coarse = [np.arange(0, n + TABLE_SPACING, TABLE_SPACING) * step for n in reversed(shape)]
    rays, seen = view1.camera.unproject(np.stack(np.meshgrid(*coarse), axis=-1))
    places, valid = view2.camera.project(_turned(rays, levels[:, None, None], cam2_from_cam1))
    table = np.where((valid & seen)[..., None], places, np.nan).astype(np.float32)
    fine = np.stack(np.meshgrid(*(step * np.arange(n) for n in reversed(shape))), axis=-1)
    rays1, seen1 = view1.camera.unproject(fine)
    pixels1 = fine.astype(np.float32)
    samples1 = _at(_smooth(view1, step), pixels1)
    return Sweep(
        inverse=levels,
        step_px=step,
        pixels1=pixels1,
        rays1=np.where(seen1[..., None], rays1, np.nan),
        samples1=samples1,
        costs=swept_costs(_smooth(view2, step), samples1, table, TABLE_SPACING),
        winners=np.full(shape, np.nan),
        seen=np.zeros(shape, dtype=bool),
    )


def _turned(rays: FloatArray, inverse: FloatArray, cam2_from_cam1: Rigid3) -> FloatArray:
    """Return points at inverse ranges on rays (..., 3) in the frame of camera 2, over their ranges."""
    return np.asarray(rays @ cam2_from_cam1.rotation.T + inverse[..., None] * cam2_from_cam1.translation_mm)


def _at(image: NDArray[np.float32], places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the image at places (R, C, 2); NaN outside."""
    u, v = (np.ascontiguousarray(places[..., k]) for k in (0, 1))
    nan = float("nan")
    read = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=nan)
    return np.asarray(read, np.float32)


def _smooth(view: GrowingView, step_px: float) -> NDArray[np.float32]:
    """Return the image as sharp as samples `step_px` apart can show it."""
    return np.asarray(cv2.GaussianBlur(np.asarray(view.grey, np.float32), (0, 0), SMOOTHED * step_px), np.float32)


def _contrast(view: GrowingView) -> NDArray[np.float32]:
    """Return the standard deviation of the brightness over patches around all pixels."""
    image, side = np.asarray(view.grey, np.float32), (2 * HALF_WIDTH + 1,) * 2
    variance = cv2.blur(image * image, side) - cv2.blur(image, side) ** 2
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), np.float32)


def _lit(view: GrowingView) -> NDArray[np.float32]:
    """Return 1 at the pixels that the lens reaches and 0 at those as dark as the sensor's border around its circle."""
    dark = np.asarray(view.grey) <= UNLIT_LEVELS
    _, label = cv2.connectedComponents(dark.astype(np.uint8))
    border = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    return np.asarray(~np.isin(label, border[border > 0]), np.float32)


def _winners(
    best: NDArray[np.int32], around: NDArray[np.int32], sweep: Sweep, view2: GrowingView, cam2_from_cam1: Rigid3
) -> tuple[FloatArray, BoolArray]:
    """Return the levels (R, C), between the `best` by a parabola, and where image 2 sees that surface."""
    count = len(sweep.inverse)
    inner = np.clip(best, 1, count - 2)
    left, middle, right = np.moveaxis(around[..., 1:].astype(np.float64), -1, 0)
    bend = left - 2.0 * middle + right
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(bend > 0.0, 0.5 * (left - right) / bend, 0.0)
    level = np.asarray(np.clip(inner + part, 0.0, count - 1.0), np.float64)
    # At either end the surface may be beyond.
    inside = (best > 0) & (best < count - 1)
    place, seen = view2.camera.project(_turned(sweep.rays1, sweep.inverse[best], cam2_from_cam1))
    inside &= seen
    width, height = view2.size_px
    with np.errstate(invalid="ignore"):
        inside &= ((place >= 0.0) & (place <= np.array([width - 1, height - 1]))).all(axis=-1)
    place = np.where(inside[..., None], place, 0.0)
    cost = np.where(inside, around[..., 0], np.iinfo(np.int32).max)
    good = inside & _foremost(place, best, cost, sweep.step_px, view2)
    return level, good


def _reliable(sweep: Sweep, good: BoolArray, grown: FloatArray) -> BoolArray:
    """Return which `good` samples (R, C) are on surfaces that are no chance.

    A surface goes on where neighbours are no more than a level apart; `grown` are the levels (R, C) of patches. One
    that no patch agrees with, as beside many edges of depth, is to be large, or cheap beside itself at other ranges.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    level = sweep.winners
    number = np.arange(level.size).reshape(level.shape)
    links = []
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        same = good[one] & good[other] & (np.abs(level[one] - level[other]) <= 1.0)
        links.append((number[one][same], number[other][same]))
    rows, columns = (np.concatenate(ends) for ends in zip(*links, strict=True))
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(level.size, level.size))
    _, label = connected_components(graph, directed=False)
    with np.errstate(invalid="ignore"):
        agrees = good & (np.abs(level - grown) <= 1.0)
    size, agreed = np.bincount(label), np.bincount(label, weights=agrees.ravel()) > 0.0
    reliable = size >= SMALLEST
    alone = np.flatnonzero((reliable & ~agreed & (size < LARGE))[label])
    reliable &= agreed | (size >= LARGE) | (_of_shifted(sweep, alone, label[alone], len(size)) < MAX_OF_SHIFTED)
    return np.asarray(good & reliable[label].reshape(level.shape))


def _of_shifted(sweep: Sweep, samples: IntArray, label: IntArray, count: int) -> FloatArray:
    """Return the costs of surfaces over the least that they have at other ranges, (count,); NaN of those not asked for.

    `samples` (M,) are theirs, `label` (M,) says of which. Ranges at which half of one is beyond the sweep do not count.
    """
    levels = len(sweep.inverse)
    at = np.rint(sweep.winners.ravel()[samples]).astype(np.int64)
    costs = sweep.costs.reshape(-1, sweep.costs.shape[-1])[samples]
    size = np.bincount(label, minlength=count)

    def mean(shift: int) -> FloatArray:
        inside = (at + shift >= 0) & (at + shift < levels)
        of = label[inside]
        known = np.bincount(of, minlength=count)
        total = np.bincount(of, weights=costs[inside, at[inside] + shift], minlength=count)
        return np.where(2 * known > size, total / np.maximum(known, 1), np.inf)

    others = [shift for shift in range(-levels, levels) if abs(shift) >= SHIFTED_LEVELS]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mean(0) / np.min([mean(shift) for shift in others], axis=0), np.float64)


def _foremost(
    place: Pixels, best: NDArray[np.int32], cost: NDArray[np.int32], step_px: float, view2: GrowingView
) -> BoolArray:
    """Return which samples (R, C) agree with the cheapest that claims the same place of image 2."""
    columns = int(view2.size_px[0] // step_px) + 2
    cell = np.rint(place / step_px).astype(np.int64)
    cell = (cell[..., 1] * columns + cell[..., 0]).ravel()
    order = np.argsort(-cost.ravel(), kind="stable")
    claimed = np.zeros(cell.max() + 1, dtype=np.int32)
    claimed[cell[order]] = best.ravel()[order]
    return np.asarray(np.abs(claimed[cell].reshape(best.shape) - best) <= 1)


def _with(
    grown: GrownPatches,
    inverse: FloatArray,
    sigma: float,
    view1: GrowingView,
    view2: GrowingView,
    cam2_from_cam1: Rigid3,
) -> GrownPatches:
    """Return the pairs, at nodes without one with those of the inverse ranges (R, C; NaN: unknown) instead."""
    at = np.isfinite(inverse) & (inverse > 0.0) & ~grown.valid
    # The surface that faces the camera.
    z = np.pad(inverse[at][:, None], ((0, 0), (0, 2)))
    return with_pairs(grown, at, z, np.full(len(z), sigma), view1, view2, cam2_from_cam1)


def with_pairs(
    grown: GrownPatches,
    at: BoolArray,
    z: FloatArray,
    sigma: FloatArray,
    view1: GrowingView,
    view2: GrowingView,
    cam2_from_cam1: Rigid3,
) -> GrownPatches:
    """Return the pairs, at the nodes `at` (R, C) with those of N inverse ranges and their gradients z (N, 3) instead.

    `sigma` (N,) is of the inverse ranges. No pair is where image 2 does not see the surface.
    """
    pixels1, inverse = view1.nodes(grown.step)[at], z[:, 0]
    rays, _ = view1.camera.unproject(pixels1)
    points = rays / inverse[:, None]
    pixels2, seen = view2.camera.project(cam2_from_cam1.apply(points))
    rays2, seen2 = view2.camera.unproject(pixels2)
    B1, B2 = view1.camera.ray_jacobian(pixels1), view2.camera.ray_jacobian(pixels2)
    J1, J2 = pair_projection_jacobians(points, rays, B1, rays2, B2, cam2_from_cam1)
    G, by_range, _ = linear_gauge(J1, J2)
    by_inverse = by_range / (inverse**2)[:, None]
    A21 = G - by_inverse[:, :, None] * z[:, None, 1:]
    sigma_px = sigma * np.linalg.norm(by_inverse, axis=1)
    good = seen & seen2 & np.isfinite(A21).all(axis=(1, 2))
    grown = grown.where(~at)
    at = at.copy()
    at[at] = good
    out = {name: getattr(grown, name).copy() for name in ("pixels1", "pixels2", "A21", "correlation", "coarser")}
    new = {"pixels1": pixels1[good], "pixels2": pixels2[good], "A21": A21[good], "correlation": 0.0, "coarser": 0.0}
    for name, values in new.items():
        out[name][at] = values
    spread = grown.covariance.copy()
    spread[at] = SIGMA_A**2 * np.eye(6)
    spread[at, 0, 0] = spread[at, 1, 1] = sigma_px[good] ** 2
    return replace(grown, covariance=spread, **out)
