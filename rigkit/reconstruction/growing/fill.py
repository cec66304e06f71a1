"""Fill holes of a surface with planes of the sweep, or with those of neighbours that agree with it.

At a depth edge the windows of patches contain two surfaces, and on dull ones they contain too little. There the sweep
has a surface of its own, to which planes are fitted over the samples of similar brightness (K.-J. Yoon and I. S. Kweon,
"Adaptive Support-Weight Approach for Correspondence Search", PAMI 2006). A plane of patches nearby that agrees is more
accurate, above all in its normal, and replaces it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.kernels.sweep import LevelPlanes, fitted_level_planes
from rigkit.optim.robust_scale import robust_sigma
from rigkit.reconstruction.growing.grow import GrowingView, GrownPatches, PosedViews
from rigkit.reconstruction.growing.surface import GrownSurface
from rigkit.reconstruction.growing.sweep import ALIKE_LEVELS, RIVAL_RADIUS, Sweep, replace_pairs

REACHES = (1, 2, 4)
"""Distances, in nodes, of the neighbours in eight directions: up to the reach of a plane's fit."""
OFFSETS = np.array([(r * i, r * j) for r in REACHES for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
FIT_REACH = 8
"""Half side, in samples, of the window of a plane of the sweep: about that of the nodes of `surface.PLANE_REACH_PX`.
Over 5 samples normals are a quarter further off and ranges alike (motorcycle, REAL)."""
SAME_PLANE_PX = 0.5
"""Largest difference along the epipolar line of planes that agree: finer than the sweep's samples."""
COMPARED_EVERY = 4
"""One of so many nodes with planes of patches gets a plane of the sweep, too, for its sigmas."""


def at_best_depth(
    surface: GrownSurface, grown: GrownPatches, slope: FloatArray, sweep: Sweep, view1: GrowingView
) -> BoolArray:
    """Return a mask (R, C) of the nodes whose plane fits the images better than any parallel one, both at the node and
    at the pixel that its patch measured, which may be beyond an edge."""
    out = surface.valid.copy()
    for pixels1 in (grown.pixels1, view1.nodes(grown.step)):
        at = out.copy()
        out[at] = sweep.distinct(pixels1[at], surface.plane[at], slope[at], surface.support[at])
    return out


def fill_holes(
    surface: GrownSurface, grown: GrownPatches, sweep: Sweep, views: PosedViews, shared_px: float = 0.0
) -> tuple[GrownSurface, GrownPatches]:
    """Return the surface with its holes filled by planes of the sweep, and the pairs with those of these planes.

    A plane must fit the pixels better than any parallel one, by a margin that grows as fewer samples around it agree.
    `shared_px` is an error along the epipolar lines that is common to all nodes around.
    """
    nodes = views.view1.nodes(grown.step)
    there = sweep.reliable[sweep.nearest(nodes)]
    compared = np.flatnonzero(there & surface.valid)[::COMPARED_EVERY]
    holes = np.flatnonzero(there & ~surface.valid)
    both = _swept_planes(np.concatenate([compared, holes]), grown.step, sweep, views)
    scale = _noise_over_scatter(both, surface.plane.reshape(-1, 3)[both.nodes])
    planes = both.select(np.flatnonzero(~surface.valid.ravel()[both.nodes]))
    good = sweep.cost_over_rivals(planes.pixels1, planes.plane, planes.slope) < planes.agree
    planes = planes.select(np.flatnonzero(good))
    covariance = scale**2 * planes.covariance
    covariance += ((shared_px / planes.slope) ** 2)[:, None, None] * planes.rays[:, :, None] * planes.rays[:, None, :]
    choice = _agreeing_neighbours(surface, planes)
    near = choice.source >= 0
    source = choice.source[near]
    plane, own = planes.plane.copy(), planes.rays[near]
    plane[near] = surface.plane.reshape(-1, 3)[source]
    # An extended plane has an additional error by the curvature of the surface.
    bends = choice.scatter[near, None, None] * own[:, :, None] * own[:, None, :]
    covariance[near] = surface.covariance.reshape(-1, 3, 3)[source] + bends
    return _with_planes(surface, grown, planes, plane, covariance, views)


class _SweptPlanes(NamedTuple):
    """Planes of a sweep at N nodes: `agree` (N,) is the share of the samples around that lie in them.

    `covariance` (N, 3, 3) is for independent samples; `slope` (N,) as in `NodeMeasurements`."""

    nodes: IntArray
    pixels1: FloatArray
    rays: FloatArray
    plane: FloatArray
    covariance: FloatArray
    slope: FloatArray
    agree: FloatArray

    def select(self, which: IntArray) -> _SweptPlanes:
        """Return some of the planes."""
        return self._replace(**{name: getattr(self, name)[which] for name in self._fields})


def _swept_planes(nodes: IntArray, step: int, sweep: Sweep, views: PosedViews) -> _SweptPlanes:
    """Return the planes of the sweep's surface at row-major `nodes`; those behind the camera are left out."""
    at = sweep.nearest(views.view1.nodes(step).reshape(-1, 2)[nodes])
    fits: LevelPlanes = fitted_level_planes(
        sweep.winners,
        sweep.seen,
        sweep.samples1,
        np.stack(at, axis=1),
        reach=FIT_REACH,
        radius=RIVAL_RADIUS,
        alike=ALIKE_LEVELS,
    )
    spacing = sweep.inverse[1] - sweep.inverse[0]
    # Inverse range, and its gradient by the pixel.
    to_z = spacing * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0 / sweep.step_px], [0.0, 1.0 / sweep.step_px, 0.0]])
    z = fits.planes @ to_z.T
    z[:, 0] += sweep.inverse[0]
    # Planes in which fewer samples lie err more: in proportion to 1 / agree (motorcycle, REAL, shares of 0.6 to 1).
    of_z = to_z @ ((fits.variance / fits.agree**2)[:, None, None] * np.linalg.inv(fits.normals)) @ to_z.T
    pixels1, rays = sweep.pixels1[at].astype(np.float64), sweep.rays1[at]
    frame = np.concatenate([rays[:, None, :], np.swapaxes(views.view1.camera.ray_jacobian(pixels1), 1, 2)], axis=1)
    to_plane = np.linalg.inv(frame)
    half = 0.5 * spacing
    (first, seen1), (second, seen2) = (views.project(rays, z[:, 0] + change) for change in (-half, half))
    slope = np.where(seen1 & seen2, np.linalg.norm(second - first, axis=1) / spacing, np.nan)
    planes = _SweptPlanes(
        nodes,
        pixels1,
        rays,
        np.einsum("nij,nj->ni", to_plane, z),
        to_plane @ of_z @ np.swapaxes(to_plane, 1, 2),
        slope,
        fits.agree,
    )
    return planes.select(np.flatnonzero((z[:, 0] > 0.0) & np.isfinite(slope)))


def _noise_over_scatter(planes: _SweptPlanes, of_patches: FloatArray) -> float:
    """Return the noise of the ranges of planes, by planes (N, 3) of patches, over that of independent samples.

    Samples are not independent: they share pixels and paths. Planes of patches are NaN in holes.
    """
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", planes.rays, planes.covariance, planes.rays))
    off = np.abs(np.sum((planes.plane - of_patches) * planes.rays, axis=1))
    known = (sigma > 0.0) & np.isfinite(off)
    return max(robust_sigma(off[known] / sigma[known]), 1.0) if known.any() else 1.0


class _Choice(NamedTuple):
    """Node (N,) whose plane each hole gets, -1 for none, and the mean squared difference (N,) of the inverse ranges of
    the neighbours that agree with it."""

    source: IntArray
    scatter: FloatArray


def _agreeing_neighbours(surface: GrownSurface, planes: _SweptPlanes) -> _Choice:
    """Return, for each hole, the node around it whose plane agrees best with that of the sweep."""
    around = _neighbours(planes.nodes, surface.valid.shape)
    inverse = np.einsum("nki,ni->nk", surface.plane.reshape(-1, 3)[around], planes.rays)
    here = np.sum(planes.plane * planes.rays, axis=1)[:, None]
    known = (around >= 0) & (inverse > 0.0)
    best = np.where(known, np.abs(inverse - here), np.inf).argmin(axis=1)[:, None]
    chosen = np.take_along_axis(inverse, best, axis=1)
    same = known & (np.abs(inverse - chosen) * planes.slope[:, None] < SAME_PLANE_PX)
    scatter = np.sum((inverse - chosen) ** 2, axis=1, where=same) / np.maximum(same.sum(axis=1), 1)
    agrees = np.abs(chosen - here)[:, 0] * planes.slope < SAME_PLANE_PX
    return _Choice(np.where(agrees, np.take_along_axis(around, best, axis=1)[:, 0], -1), scatter)


def _neighbours(nodes: IntArray, shape: tuple[int, ...]) -> IntArray:
    """Return the row-major indices (M, K) of the nodes around each of M; -1 outside of the grid."""
    row, column = (index[:, None] + OFFSETS[:, k] for k, index in enumerate(np.unravel_index(nodes, shape)))
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    return np.where(inside, row * shape[1] + column, -1)


def _with_planes(
    surface: GrownSurface,
    grown: GrownPatches,
    planes: _SweptPlanes,
    plane: FloatArray,
    covariance: FloatArray,
    views: PosedViews,
) -> tuple[GrownSurface, GrownPatches]:
    """Return the surface and the pairs with `plane` (N, 3) and its `covariance` at the nodes of `planes`."""
    view1 = views.view1
    nodes = view1.nodes(grown.step).reshape(-1, 2)[planes.nodes]
    rays, seen = view1.camera.unproject(nodes)
    inverse = np.sum(plane * rays, axis=1)
    good = seen & (inverse > 0.0)
    at, rays, inverse, plane, covariance = (v[good] for v in (planes.nodes, rays, inverse, plane, covariance))
    frame = np.concatenate([rays[:, None], np.swapaxes(view1.camera.ray_jacobian(nodes[good]), 1, 2)], axis=1)
    new = np.zeros(surface.valid.shape, dtype=bool)
    new.ravel()[at] = True
    z = np.einsum("nij,nj->ni", frame, plane)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", rays, covariance, rays))
    grown = replace_pairs(grown, new, z, sigma, views)
    values = {
        "points": rays / inverse[:, None],
        "normals": -plane / np.linalg.norm(plane, axis=1, keepdims=True),
        "plane": plane,
        "covariance": covariance,
        "support": planes.agree[good],
    }
    whole = {name: getattr(surface, name).copy() for name in values}
    for name, value in values.items():
        whole[name].reshape(-1, *value.shape[1:])[at] = value
    return replace(surface, **whole).where(surface.valid | (new & grown.valid)), grown
