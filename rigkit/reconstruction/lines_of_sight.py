"""Where near and far points meet in a picture, the surface between them is a line of sight: the camera saw along it.

A surface through points alone bridges such an edge of depth by a slope, and hides what is behind. Points along the
line of sight, whose normals are across it, towards the far side, tell Poisson's method that it is empty there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Normals, Points
from rigkit.core.cloud import OrientedCloud
from rigkit.geometry.rotation import angle_between, unit

STEEP = 3.0
"""Rise of the logarithm of the distance over the angle: seen at 18 degrees or less."""
OPEN_RISE = 0.5
"""Share of the rise that either point's plane leaves open: else it is one slanted surface."""
MAX_STEPS = 5.0
"""Between neighbours, in the usual angle between neighbours: beyond, nobody knows where between them the edge is."""
SPACING = 2.0
"""Of the points along a line of sight, in the distance between neighbours on the near surface."""
MIN_FORWARD = -0.99
"""Cosine from the axis: the stereographic plane ends opposite to it."""


def with_lines_of_sight(cloud: OrientedCloud) -> OrientedCloud:
    """Return a cloud that was seen from its origin with further points along the lines of sight at edges of depth.

    Their sigmas are NaN: nothing was measured there. Neighbours are those of the Delaunay triangulation of the
    directions (stereographic, so for fisheye lenses as well).
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
    """Return the near and the far point (K,) of every pair of neighbours between which no surface was seen."""
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
    edge = (rise > STEEP * angle) & (angle < MAX_STEPS * np.median(angle))
    for one, other in ((near, far), (far, near)):
        edge &= _missed(points[one], normals[one], rays[other], distance[other]) > OPEN_RISE * rise
    return near[edge], far[edge]


def _missed(points: Points, normals: Normals, rays: FloatArray, distance: FloatArray) -> FloatArray:
    """Return by how much (N,) planes miss points on other rays, in the logarithm of the distance; inf: never met."""
    with np.errstate(divide="ignore", invalid="ignore"):
        there = np.sum(normals * points, axis=1) / np.sum(normals * rays, axis=1)
        met: BoolArray = np.isfinite(there) & (there > 0.0)
        return np.where(met, np.abs(np.log(distance / np.where(met, there, 1.0))), np.inf)
