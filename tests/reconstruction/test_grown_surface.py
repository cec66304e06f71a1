"""Planes through what nodes say of a flat wall with a hole: where it ends, and how sure they are there."""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.reconstruction.growing.grow import HALF_WIDTH
from rigkit.reconstruction.growing.surface import GrownSurface, NodeMeasurements, fit_surface

STEP = 3
SHAPE = (70, 90)
HOLE = np.s_[25:45, 30:60]
CAMERA = Pinhole((STEP * SHAPE[1], STEP * SHAPE[0]), np.array([300.0, 300.0, 134.5, 104.5]))
WALL = np.array([0.0002, -0.0001, 0.001])
"""m of m . X = 1: a wall a metre away."""
NOISE_PX, SLOPE_PX = 0.1, 2e4
AT_END_MORE = 3.0
"""Times the stated noise that nodes have beside the hole."""


def beside_the_hole() -> BoolArray:
    """Which nodes are as near to the hole as a patch reaches."""
    hole = np.zeros(SHAPE, np.uint8)
    hole[HOLE] = 1
    far = cv2.distanceTransform(1 - hole, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * STEP
    return np.asarray((far > 0.0) & (far <= HALF_WIDTH + STEP))


def fitted(times: FloatArray, rng: np.random.Generator) -> GrownSurface:
    """Return the planes where nodes err by `times` (R, C) what they state."""
    pixels = np.stack(np.meshgrid(*(STEP * np.arange(float(n)) for n in SHAPE[::-1])), axis=-1)
    rays, _ = CAMERA.unproject(pixels)
    frame = np.concatenate([rays[..., None, :], np.swapaxes(CAMERA.ray_jacobian(pixels), -1, -2)], axis=-2)
    sigma = NOISE_PX / SLOPE_PX * np.array([1.0, 0.1, 0.1])
    z = frame @ WALL + times[..., None] * sigma * rng.normal(size=(*SHAPE, 3))
    z[HOLE] = np.nan
    return fit_surface(
        NodeMeasurements(
            z=z,
            covariance=np.broadcast_to(np.diag(sigma**2), (*SHAPE, 3, 3)).copy(),
            frame=frame,
            slope=np.full(SHAPE, SLOPE_PX),
            swept=np.zeros(SHAPE, dtype=bool),
        ),
        STEP,
    )


def growth_of_sigmas(surface: GrownSurface, beside: BoolArray) -> float:
    """Return by how much larger the sigmas of ranges are beside the hole than inside the wall."""
    rays, _ = CAMERA.unproject(np.stack(np.meshgrid(*(STEP * np.arange(float(n)) for n in SHAPE[::-1])), axis=-1))
    sigma = np.sqrt(np.einsum("...i,...ij,...j->...", rays, surface.covariance, rays))
    inner = surface.valid & ~surface.at_end
    assert inner.sum() > 1000
    return float(np.median(sigma[beside & surface.valid]) / np.median(sigma[inner]))


def test_a_surface_ends_where_nothing_is_known_or_something_else_is(rng: np.random.Generator) -> None:
    beside = beside_the_hole()
    surface = fitted(np.ones(SHAPE), rng)
    # Planes go on a little into the hole.
    assert surface.at_end[beside].mean() > 0.5
    far_from_hole = cv2.erode((~beside).astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=1) > 0
    far_from_hole[HOLE] = False
    assert not surface.at_end[far_from_hole].any()


def test_sigmas_grow_where_nodes_at_the_end_disagree_with_their_planes(rng: np.random.Generator) -> None:
    beside = beside_the_hole()
    as_stated = growth_of_sigmas(fitted(np.ones(SHAPE), rng), beside)
    worse = growth_of_sigmas(fitted(np.where(beside, AT_END_MORE, 1.0), rng), beside)
    # Fewer nodes around make planes less sure in either case.
    assert 1.0 <= as_stated < 2.0
    assert worse > 1.7 * as_stated
