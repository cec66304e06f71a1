"""Fill holes of a surface with planes of neighbours that agree with the pixels.

Neighbouring pixels mostly share a plane (M. Bleyer, C. Rhemann and C. Rother, "PatchMatch Stereo", BMVC 2011). Windows
at a depth edge contain two surfaces, and the plane fitted there is of neither; planes from further inside may extend to
the edge. They are tested as all planes are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.growing.grow import GrowingView, GrownPatches
from rigkit.reconstruction.growing.surface import GrownSurface
from rigkit.reconstruction.growing.sweep import Sweep, replace_pairs

REACHES = (1, 2, 4)
"""Distances, in nodes, of the neighbours in eight directions: up to the reach of a plane's fit."""
OFFSETS = np.array([(r * i, r * j) for r in REACHES for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
MAX_OF_RIVAL_PROPAGATED = 1.8
"""As MAX_OF_RIVAL, for the best of many planes that were not measured there: planes between 1.8 and 2.2 are wrong more
than twice as often (22 % on motorcycle, REAL; two thirds on RENDERED dull cards)."""
PROPAGATION_ROUNDS = 2
"""Later rounds reach further but are wrong more often (motorcycle, REAL: 13, 22 and 24 % in rounds 1 to 3, measured
before the other limits were final)."""
SAME_PLANE_PX = 0.5
"""Largest difference along the epipolar line of planes that agree: finer than the sweep's samples."""


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


def propagate_planes(
    surface: GrownSurface,
    grown: GrownPatches,
    slope: FloatArray,
    sweep: Sweep,
    view1: GrowingView,
    view2: GrowingView,
    cam2_from_cam1: Rigid3,
) -> tuple[GrownSurface, GrownPatches]:
    """Return the surface with its holes filled by planes of neighbours, and the pairs with those of these planes.

    `slope` (R, C) is the derivative, in px along the epipolar line, by the inverse range.
    """
    nodes = view1.nodes(grown.step)
    rays, seen = view1.camera.unproject(nodes)
    seen &= sweep.seen[sweep.nearest(nodes)]
    plane, support, slope = surface.plane.copy(), surface.support.copy(), slope.copy()
    scatter = np.zeros(seen.shape)
    source = np.arange(seen.size).reshape(seen.shape)
    fresh = surface.valid.ravel()
    for _ in range(PROPAGATION_ROUNDS):
        holes = np.flatnonzero(seen & ~np.isfinite(plane[..., 0]))
        around = _neighbours(holes, seen.shape)
        # Only holes close to planes of the last round can change.
        near = (fresh[around] & (around >= 0)).any(axis=1)
        holes, around = holes[near], around[near]
        best = _best(sweep, nodes.reshape(-1, 2)[holes], rays.reshape(-1, 3)[holes], plane, slope, around)
        good = best.source >= 0
        holes, origin = holes[good], best.source[good]
        fresh = np.zeros(seen.size, dtype=bool)
        fresh[holes] = True
        support.ravel()[holes], scatter.ravel()[holes] = best.agree[good], best.scatter[good]
        for values in (plane.reshape(-1, 3), slope.reshape(-1), source.reshape(-1)):
            values[holes] = values[origin]
    new = np.isfinite(plane[..., 0]) & ~surface.valid
    inverse = np.sum(plane * rays, axis=-1)
    # An extended plane has an additional error by the curvature of the surface.
    bends = scatter[..., None, None] * rays[..., :, None] * rays[..., None, :]
    covariance = np.where(
        new[..., None, None], surface.covariance.reshape(-1, 3, 3)[source] + bends, surface.covariance
    )
    frame = np.concatenate([rays[new][:, None], np.swapaxes(view1.camera.ray_jacobian(nodes[new]), 1, 2)], axis=1)
    z = np.einsum("nij,nj->ni", frame, plane[new])
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", rays[new], covariance[new], rays[new]))
    grown = replace_pairs(grown, new, z, sigma, view1, view2, cam2_from_cam1)
    new &= grown.valid
    known = surface.valid | new
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.where(new[..., None], rays / inverse[..., None], surface.points)
        normals = np.where(new[..., None], -plane / np.linalg.norm(plane, axis=-1, keepdims=True), surface.normals)
    whole = replace(surface, points=points, normals=normals, plane=plane, covariance=covariance, support=support)
    return whole.where(known), grown


def _neighbours(nodes: IntArray, shape: tuple[int, ...]) -> IntArray:
    """Return the row-major indices (M, K) of the nodes around each of M; -1 outside of the grid."""
    row, column = (index[:, None] + OFFSETS[:, k] for k, index in enumerate(np.unravel_index(nodes, shape)))
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    return np.where(inside, row * shape[1] + column, -1)


class _Choice(NamedTuple):
    """Node (M,) whose plane each of M pixels gets, -1 for none; fraction (M,) of the neighbours' planes that agree with
    it, and the mean squared difference (M,) of their inverse ranges."""

    source: IntArray
    agree: FloatArray
    scatter: FloatArray


def _best(
    sweep: Sweep, pixels1: Pixels, rays: FloatArray, plane: FloatArray, slope: FloatArray, around: IntArray
) -> _Choice:
    """Return, for each pixel, the node of `around` (M, K) whose plane has the least cost."""
    planes, slopes = plane.reshape(-1, 3)[around], slope.reshape(-1)[around]
    inverse = np.einsum("mki,mi->mk", planes, rays)
    known = (around >= 0) & (inverse > 0.0)
    cost_over_rivals = np.full(known.shape, np.inf)
    which, _ = np.nonzero(known)
    cost_over_rivals[known] = sweep.cost_over_rivals(pixels1[which], planes[known], slopes[known])
    best = cost_over_rivals.argmin(axis=1)[:, None]
    least, here, slope_here = (
        np.take_along_axis(values, best, axis=1) for values in (cost_over_rivals, inverse, slopes)
    )
    off = np.where(known, inverse - here, np.inf)
    same = np.abs(off) * slope_here < SAME_PLANE_PX
    agree = same.mean(axis=1)
    scatter = np.sum(off**2, axis=1, where=same) / np.maximum(same.sum(axis=1), 1)
    good = least[:, 0] < MAX_OF_RIVAL_PROPAGATED * agree
    return _Choice(np.where(good, np.take_along_axis(around, best, axis=1)[:, 0], -1), agree, scatter)
