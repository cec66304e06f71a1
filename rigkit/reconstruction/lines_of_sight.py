"""Add points along the lines of sight at depth edges, so that a mesh does not bridge them.

A surface through measured points only would join a near and a far surface by a slope. Points along the line of sight,
with normals perpendicular to it and towards the far side, tell Poisson reconstruction that this space is empty.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Normals, Points
from rigkit.core.cloud import OrientedCloud
from rigkit.geometry.rotation import angle_between, unit

STEEP = 3.0
"""Least d log(distance) / d angle of a depth edge: a surface there would be seen at 18 degrees or less."""
OPEN_RISE = 0.5
"""Least share of the rise that neither point's plane explains: else both are on one slanted surface."""
MAX_STEP_RATIO = 5.0
"""Largest angle between neighbours, over their median angle: beyond, the place of the edge is unknown."""
SPACING = 2.0
"""Spacing of added points, over the distance between neighbours on the near surface."""
MIN_FORWARD = -0.99
"""Least cosine from the axis: the stereographic projection ends opposite to it."""


def with_lines_of_sight(cloud: OrientedCloud) -> OrientedCloud:
    """Return a cloud that was seen from its origin, with points added along the lines of sight at depth edges.

    The added points were not measured: their sigmas are NaN. Neighbours are those of the Delaunay triangulation of the
    directions, in stereographic projection so that fisheye lenses work as well.
    """
    rays = unit(cloud.points_mm)
    usable = np.flatnonzero((rays[:, 2] > MIN_FORWARD) & cloud.normals.any(axis=1))
    near, far = _edges_of_depth(cloud.points_mm[usable], cloud.normals[usable])
    if not near.size:
        return cloud
    near, far = usable[near], usable[far]
    distance = np.linalg.norm(cloud.points_mm, axis=1)
    rise = np.log(distance[far] / distance[near])
    angle = angle_between(rays[near], rays[far])
    count = np.ceil(rise / (SPACING * np.maximum(angle, np.median(angle)))).astype(np.int64)
    of = np.repeat(np.arange(len(near)), count)
    place = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    middle = unit(rays[near] + rays[far])
    across = rays[far] - rays[near]
    across = unit(across - np.sum(across * middle, axis=1)[:, None] * middle)
    along = distance[near][of] * np.exp((place + 0.5) / count[of] * rise[of])
    added = len(of)
    return replace(
        cloud,
        points_mm=np.concatenate([cloud.points_mm, along[:, None] * middle[of]]),
        normals=np.concatenate([cloud.normals, across[of]]),
        colours=np.concatenate([cloud.colours, cloud.colours[near][of]]),
        board_index=np.concatenate([cloud.board_index, np.full(added, -1)]),
        grid=np.concatenate([cloud.grid, np.zeros((added, 2), dtype=cloud.grid.dtype)]),
        sigma_mm=np.concatenate([cloud.sigma_mm, np.full(added, np.nan)]),
        normal_sigma_rad=np.concatenate([cloud.normal_sigma_rad, np.full(added, np.nan)]),
    )


def _edges_of_depth(points: Points, normals: Normals) -> tuple[IntArray, IntArray]:
    """Return the indices (K,) of the near and the far point of every depth edge between neighbours."""
    from scipy.spatial import Delaunay, QhullError

    none = np.zeros(0, dtype=np.int64)
    distance = np.linalg.norm(points, axis=1)
    rays = points / distance[:, None]
    try:
        corners = Delaunay(rays[:, :2] / (1.0 + rays[:, 2:])).simplices
    except (QhullError, ValueError):
        # Fewer than three directions, or all in one plane: there is nothing between them.
        return none, none
    sides = np.sort(corners[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1)
    a, b = np.unique(sides, axis=0).T
    near = np.where(distance[a] < distance[b], a, b)
    far = a + b - near
    angle = angle_between(rays[near], rays[far])
    rise = np.log(distance[far] / distance[near])
    edge = (rise > STEEP * angle) & (angle < MAX_STEP_RATIO * np.median(angle))
    for one, other in ((near, far), (far, near)):
        edge &= _distance_to_plane(points[one], normals[one], rays[other], distance[other]) > OPEN_RISE * rise
    return near[edge], far[edge]


def _distance_to_plane(points: Points, normals: Normals, rays: FloatArray, distance: FloatArray) -> FloatArray:
    """Return the distance (N,) along `rays` between planes and points, in log(distance); inf if they do not meet."""
    with np.errstate(divide="ignore", invalid="ignore"):
        there = np.sum(normals * points, axis=1) / np.sum(normals * rays, axis=1)
        met: BoolArray = np.isfinite(there) & (there > 0.0)
        return np.where(met, np.abs(np.log(distance / np.where(met, there, 1.0))), np.inf)
