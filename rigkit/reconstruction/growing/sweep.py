"""Find surfaces where patches do not grow: semi-global matching of a range sweep, for any central cameras.

Each level of the sweep maps every ray of image 1, at one range, to a pixel of image 2. Both images agree there if the
surface has that range (R. T. Collins, "A Space-Sweep Approach to True Multi-Image Matching", CVPR 1996). They are
compared by the census transform (R. Zabih and J. Woodfill, ECCV 1994), and smoothness is enforced along eight paths (H.
Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008). Levels are equally spaced
in inverse range, in which planes are linear. Images are not rectified.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.affine.normal import linear_gauge
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.kernels.sweep import CENSUS_BITS, swept_costs, swept_rivals, swept_surfaces
from rigkit.optim.robust_scale import robust_sigma
from rigkit.reconstruction.growing.grow import HALF_WIDTH, GrowingView, GrownPatches, PosedViews
from rigkit.reconstruction.growing.surface import NodeMeasurements

SAMPLES_A_NODE = 2
"""Samples of the sweep for each node, along each axis."""
MAX_SWEEP_LEVELS = 160
FARTHER, NEARER = 0.1, 0.5
"""Extension of the interval of grown inverse ranges to each side. A nearer object with too little texture to grow, but
outside of the sweep, would match wrongly wherever its texture repeats."""
CURVATURE_COST = CENSUS_BITS // 6
"""Cost, in bits of the census, of a step to the next level."""
JUMP_COST = 2 * CENSUS_BITS
"""Cost of any larger step in uniform brightness; less at brightness edges."""
EVEN_LEVELS = 8.0
"""Grey-level difference between samples that halves the jump cost."""
SMOOTHED = 0.4
"""Standard deviation, in samples, of the smoothing of the images against aliasing."""
TABLE_SPACING = 8
"""Spacing, in samples, of projected rays; pixels in between are interpolated."""
SMALLEST = 60
"""Least number of samples of a surface; smaller ones are chance."""
LARGE = 1000
"""Samples from which a surface without any agreeing patch is no chance. Of 820 surfaces through two unrelated images
the largest has 976 (SIMULATED: 30 to 150 levels, noise and textures of falling spectra)."""
MAX_OF_SHIFTED = 0.4
"""Largest cost of a smaller surface over that of the same surface at any other range. Three of those 820 have less,
most 0.5 to 0.6: the cheapest of all surfaces costs half as much as others by selection alone."""
SHIFTED_LEVELS = 3
"""Least shift of such another range: blurred detail is similar over two levels."""
MAX_RESIDUAL_LEVELS = 1.0
"""Largest standard deviation of the difference to the grown pairs for which the sweep is used."""
UNLIT_LEVELS = 8.0
"""Largest grey level of pixels without light: noise and compression."""
RIVAL_RADIUS = 5.0
"""Window radius, in samples: the reach of a patch."""
ALIKE_LEVELS = 10.0
"""Grey-level variation within a surface."""
MAX_OF_RIVAL = 2.2
"""Largest cost of a plane over that of any parallel one, over the plane's support: planes with little support must fit
the pixels better. This quotient separates planes that are wrong by more than a pixel better than either part alone, and
than a test for a nearby end of the surface; 2.2 keeps as many as these (REAL motorcycle and RENDERED cards)."""
MAX_FROM_WINNER_PX = 1.5
"""Largest distance from the sweep's surface, along the epipolar line: of planes further than 2.5 px 93 to 100 % are
wrong, of those closer than 1 px 1 to 8 % (REAL motorcycle, RENDERED cards)."""
MIN_SWEPT_CONTRAST = 1.0
"""Least standard deviation of grey levels over a patch to use the sweep: half of what patches need, because many
samples agree. Uniform areas cost nothing at any range."""
SIGMA_A = 0.3
"""Standard deviation of affinities of swept pairs: the sweep does not measure slants."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Sweep:
    """The differences of two images at K levels of inverse range.

    Attributes
    ----------
    inverse : (K,) levels, equally spaced.
    step_px : px between samples.
    pixels1, rays1, samples1 : (R, C, 2), (R, C, 3), (R, C) samples of image 1 with their rays and brightness; NaN
        without a ray.
    costs : (R, C, K or more) differing bits of the census.
    winners : (R, C) levels of the surface of least cost.
    seen : (R, C) mask of the samples whose surface is visible in image 2, and not hidden by another.
    reliable : (R, C) mask of those `seen` whose surface has contrast, and is no chance.
    """

    inverse: FloatArray
    step_px: float
    pixels1: NDArray[np.float32]
    rays1: FloatArray
    samples1: NDArray[np.float32]
    costs: NDArray[np.uint8]
    winners: FloatArray
    seen: BoolArray
    reliable: BoolArray

    def nearest(self, pixels1: Pixels) -> tuple[IntArray, IntArray]:
        """Return row and column (...) of the samples nearest to pixels (..., 2), except the last row and column."""
        rows, columns = self.samples1.shape
        at = np.clip(np.rint(pixels1 / self.step_px).astype(np.int64), 0, np.array([columns - 2, rows - 2]))
        return at[..., 1], at[..., 0]

    def near_winner(self, level: FloatArray, at: tuple[IntArray, IntArray], slope: FloatArray) -> BoolArray:
        """Return a mask (...) of the levels (...) at samples (...) that are close to the sweep's own surface.

        `slope` (...) is the derivative, in px along the epipolar line, by the inverse range.
        """
        spacing_px = (self.inverse[1] - self.inverse[0]) * slope
        return np.asarray(~(np.abs(level - self.winners[at]) * spacing_px > np.maximum(MAX_FROM_WINNER_PX, spacing_px)))

    def distinct(self, pixels1: Pixels, plane: FloatArray, slope: FloatArray, support: FloatArray) -> BoolArray:
        """Return a mask (N,) of the planes m . X = 1 (N, 3) that fit pixels (N, 2) better than all parallel planes.

        `slope` (N,) is the derivative, in px along the epipolar line, by the inverse range, `support` as in
        `GrownSurface`.
        """
        return np.asarray(self.cost_over_rivals(pixels1, plane, slope) < MAX_OF_RIVAL * support)

    def cost_over_rivals(self, pixels1: Pixels, plane: FloatArray, slope: FloatArray) -> FloatArray:
        """Return the cost (N,) of each plane over the least of any parallel plane; see `distinct` for the arguments.

        Infinite for planes far from the sweep's own surface; 1 if the sweep cannot distinguish them.

        Notes
        -----
        A window at a depth edge contains both surfaces, and the edge, which belongs to the near one. So the far surface
        seems near as far as windows reach. Samples as bright as the point are more likely on its own surface (K.-J.
        Yoon and I. S. Kweon, "Adaptive Support-Weight Approach for Correspondence Search", PAMI 2006): for these the
        true plane costs less than any parallel one.
        """
        spacing = self.inverse[1] - self.inverse[0]
        row, column = at = self.nearest(pixels1)
        level, below, right = (
            (np.einsum("ni,ni->n", plane, self.rays1[row + dr, column + dc]) - self.inverse[0]) / spacing
            for dr, dc in ((0, 0), (1, 0), (0, 1))
        )
        # The census cannot distinguish surfaces that are closer than a sample.
        step_levels = np.maximum(self.step_px / (slope * spacing), 1.0)
        surfaces = np.stack([level, below - level, right - level, step_levels], axis=1)
        out, near = np.full(len(plane), np.inf), self.near_winner(level, at, slope)
        own, other = swept_rivals(
            self.costs,
            len(self.inverse),
            self.samples1,
            np.stack(at, axis=1)[near],
            surfaces[near],
            radius=RIVAL_RADIUS,
            alike=ALIKE_LEVELS,
        ).T
        with np.errstate(divide="ignore", invalid="ignore"):
            out[near] = np.nan_to_num(own / other, nan=1.0)
        return out


def fill_by_sweep(
    grown: GrownPatches, measured: NodeMeasurements, views: PosedViews
) -> tuple[GrownPatches, Sweep | None]:
    """Return the pairs, completed by those of a sweep at nodes where none grew, and the sweep.

    If the sweep disagrees with most grown pairs it is not used, and None. If it disagrees with few, as at depth edges
    inside windows, its pairs replace these. The sigma of the sweep's ranges comes from the differences to grown pairs.
    """
    if not np.isfinite(measured.z).any():
        return grown, None
    sweep = _sweep(grown, measured, views)
    best, around = swept_surfaces(
        sweep.costs, len(sweep.inverse), sweep.samples1, bend=CURVATURE_COST, jump=JUMP_COST, even=EVEN_LEVELS
    )
    level, good = _winners(best, around, sweep, views)
    sweep = replace(sweep, winners=level, seen=good)
    good = (
        good
        & (_sampled(_contrast(views.view1), sweep.pixels1) > MIN_SWEPT_CONTRAST)
        & (_sampled(_image_circle(views.view1), sweep.pixels1) == 1.0)
    )
    spacing = sweep.inverse[1] - sweep.inverse[0]
    at_nodes = (measured.z[..., 0] - sweep.inverse[0]) / spacing
    of_grown = np.full(level.shape, np.nan)
    of_grown[::SAMPLES_A_NODE, ::SAMPLES_A_NODE] = at_nodes
    good = _reliable(sweep, good, of_grown)
    residual = robust_sigma((level - of_grown)[good & np.isfinite(of_grown)])
    if not residual < MAX_RESIDUAL_LEVELS:
        return grown, None
    at = sweep.nearest(grown.pixels1)
    grown = grown.where(grown.valid & (sweep.near_winner(at_nodes, at, measured.slope) | ~good[at]))
    inverse = np.where(good, sweep.inverse[0] + spacing * level, np.nan)[::SAMPLES_A_NODE, ::SAMPLES_A_NODE]
    grown = _with_swept_pairs(grown, inverse, residual * spacing, views)
    return grown, replace(sweep, reliable=good)


def _sweep(grown: GrownPatches, measured: NodeMeasurements, views: PosedViews) -> Sweep:
    inverse = measured.z[..., 0]
    low, high = np.nanquantile(inverse, [0.001, 0.999])
    pixel = 1.0 / float(np.nanquantile(measured.slope, 0.9))
    # A wall that faces the camera has a single range.
    farther, nearer = (max(share * (high - low), 2.0 * pixel) for share in (FARTHER, NEARER))
    low, high = max(low - farther, 0.0), high + nearer
    count = int(np.clip(np.ceil((high - low) / pixel) + 1, 3, MAX_SWEEP_LEVELS))
    levels = np.linspace(low, high, count)
    step = grown.step / SAMPLES_A_NODE
    width, height = views.view1.size_px
    shape = int((height - 1) // step) + 1, int((width - 1) // step) + 1
    coarse = [np.arange(0, n + TABLE_SPACING, TABLE_SPACING) * step for n in reversed(shape)]
    rays, seen = views.view1.camera.unproject(np.stack(np.meshgrid(*coarse), axis=-1))
    places, valid = views.project(rays, levels[:, None, None])
    table = np.where((valid & seen)[..., None], places, np.nan).astype(np.float32)
    fine = np.stack(np.meshgrid(*(step * np.arange(n) for n in reversed(shape))), axis=-1)
    rays1, seen1 = views.view1.camera.unproject(fine)
    pixels1 = fine.astype(np.float32)
    samples1 = _sampled(_smooth(views.view1, step), pixels1)
    return Sweep(
        inverse=levels,
        step_px=step,
        pixels1=pixels1,
        rays1=np.where(seen1[..., None], rays1, np.nan),
        samples1=samples1,
        costs=swept_costs(_smooth(views.view2, step), samples1, table, TABLE_SPACING),
        winners=np.full(shape, np.nan),
        seen=np.zeros(shape, dtype=bool),
        reliable=np.zeros(shape, dtype=bool),
    )


def _sampled(image: NDArray[np.float32], places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the image at pixels (R, C, 2), interpolated; NaN outside."""
    u, v = (np.ascontiguousarray(places[..., k]) for k in (0, 1))
    read = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
    return np.asarray(read, np.float32)


def _smooth(view: GrowingView, step_px: float) -> NDArray[np.float32]:
    """Return the image smoothed for samples `step_px` apart."""
    return np.asarray(cv2.GaussianBlur(np.asarray(view.grey, np.float32), (0, 0), SMOOTHED * step_px), np.float32)


def _contrast(view: GrowingView) -> NDArray[np.float32]:
    """Return the standard deviation of the brightness over patches around all pixels."""
    image, side = np.asarray(view.grey, np.float32), (2 * HALF_WIDTH + 1,) * 2
    variance = cv2.blur(image * image, side) - cv2.blur(image, side) ** 2
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), np.float32)


def _image_circle(view: GrowingView) -> NDArray[np.float32]:
    """Return 1 inside the image circle of the lens and 0 in the dark border around it."""
    dark = np.asarray(view.grey) <= UNLIT_LEVELS
    _, label = cv2.connectedComponents(dark.astype(np.uint8))
    border = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    return np.asarray(~np.isin(label, border[border > 0]), np.float32)


def _winners(
    best: NDArray[np.int32], around: NDArray[np.int32], sweep: Sweep, views: PosedViews
) -> tuple[FloatArray, BoolArray]:
    """Return the levels (R, C), refined from `best` by a parabola, and a mask (R, C) of those visible in image 2."""
    count = len(sweep.inverse)
    inner = np.clip(best, 1, count - 2)
    left, middle, right = np.moveaxis(around[..., 1:].astype(np.float64), -1, 0)
    bend = left - 2.0 * middle + right
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(bend > 0.0, 0.5 * (left - right) / bend, 0.0)
    level = np.asarray(np.clip(inner + part, 0.0, count - 1.0), np.float64)
    # At the first and last level the surface may be beyond the sweep.
    inside = (best > 0) & (best < count - 1)
    place, seen = views.project(sweep.rays1, sweep.inverse[best])
    inside &= seen
    width, height = views.view2.size_px
    with np.errstate(invalid="ignore"):
        inside &= ((place >= 0.0) & (place <= np.array([width - 1, height - 1]))).all(axis=-1)
    place = np.where(inside[..., None], place, 0.0)
    cost = np.where(inside, around[..., 0], np.iinfo(np.int32).max)
    return level, inside & _unoccluded(place, best, cost, sweep.step_px, views.view2)


def _reliable(sweep: Sweep, good: BoolArray, grown: FloatArray) -> BoolArray:
    """Return a mask (R, C) of the `good` samples on reliable surfaces.

    A surface is a connected set of samples whose levels differ by one at most between neighbours; `grown` are the
    levels (R, C) of patches. A surface without any agreeing patch, as at many depth edges, must be large, or cost much
    less than the same surface at other ranges.
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
    reliable &= agreed | (size >= LARGE) | (_cost_over_shifted(sweep, alone, label[alone], len(size)) < MAX_OF_SHIFTED)
    return np.asarray(good & reliable[label].reshape(level.shape))


def _cost_over_shifted(sweep: Sweep, samples: IntArray, label: IntArray, count: int) -> FloatArray:
    """Return the cost (count,) of each surface over its least cost at other ranges; NaN for those without samples.

    `samples` (M,) are indices of samples, `label` (M,) their surfaces. Ranges with half of a surface beyond the sweep
    do not count.
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


def _unoccluded(
    place: Pixels, best: NDArray[np.int32], cost: NDArray[np.int32], step_px: float, view2: GrowingView
) -> BoolArray:
    """Return a mask (R, C) of the samples that agree with the one of least cost at the same pixel of image 2."""
    columns = int(view2.size_px[0] // step_px) + 2
    cell = np.rint(place / step_px).astype(np.int64)
    cell = (cell[..., 1] * columns + cell[..., 0]).ravel()
    order = np.argsort(-cost.ravel(), kind="stable")
    claimed = np.zeros(cell.max() + 1, dtype=np.int32)
    claimed[cell[order]] = best.ravel()[order]
    return np.asarray(np.abs(claimed[cell].reshape(best.shape) - best) <= 1)


def _with_swept_pairs(grown: GrownPatches, inverse: FloatArray, sigma: float, views: PosedViews) -> GrownPatches:
    """Return the pairs, with those of the inverse ranges (R, C; NaN: unknown) at nodes that have none."""
    at = np.isfinite(inverse) & (inverse > 0.0) & ~grown.valid
    # The gradient is unknown: assume a surface that faces the camera.
    z = np.pad(inverse[at][:, None], ((0, 0), (0, 2)))
    return replace_pairs(grown, at, z, np.full(len(z), sigma), views)


def replace_pairs(
    grown: GrownPatches, at: BoolArray, z: FloatArray, sigma: FloatArray, views: PosedViews
) -> GrownPatches:
    """Return the pairs, with those at the nodes `at` (mask (R, C)) replaced by those of N inverse ranges and gradients.

    `z` (N, 3) is as in `NodeMeasurements`, `sigma` (N,) of the inverse ranges. Surfaces outside of image 2 get no pair.
    """
    view1, view2, cam2_from_cam1 = views
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
