"""Planes through noisy nodes on a flat wall with a hole: their extent and their sigmas."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

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


def range_errors(surface: GrownSurface) -> tuple[FloatArray, FloatArray]:
    """Return by how much inverse ranges (R, C) are off, and their sigmas."""
    rays, _ = CAMERA.unproject(np.stack(np.meshgrid(*(STEP * np.arange(float(n)) for n in SHAPE[::-1])), axis=-1))
    off = np.sum((surface.plane - WALL) * rays, axis=-1)
    return np.abs(off), np.sqrt(np.einsum("...i,...ij,...j->...", rays, surface.covariance, rays))


def test_fewer_of_the_nodes_around_lie_in_a_plane_beside_its_end(rng: np.random.Generator) -> None:
    surface = fitted(np.ones(SHAPE), rng)
    inner = cv2.erode((~beside_the_hole()).astype(np.uint8), np.ones((13, 13), np.uint8), borderValue=0) > 0
    inner[HOLE] = False
    # Of Gaussian noise the weights are 0.75.
    assert 0.7 < np.median(surface.support[inner]) < 0.8
    beside = surface.support[beside_the_hole()]
    assert np.nanmedian(beside) < 0.75 * np.median(surface.support[inner])


DULL = np.broadcast_to(np.arange(SHAPE[1]) >= 66, SHAPE)
"""A part of the wall, far from the hole, where windows show more than their noise."""


@pytest.mark.parametrize(
    ("where", "times"), [(beside_the_hole(), 3.0), (DULL, 2.0), (DULL, 1.0)], ids=["end", "dull", "as-stated"]
)
def test_sigmas_hold_where_nodes_err_by_more_than_they_state(where: BoolArray, times: float) -> None:
    both = [range_errors(fitted(np.where(where, times, 1.0), np.random.default_rng(k))) for k in range(8)]
    for part in (where, ~where):
        within = np.concatenate([(off / sigma)[part & np.isfinite(off)] for off, sigma in both])
        # Some 15 planes of a part share no node, eight times: of 68 and 95 % a share is known to 4 and 2.
        assert 0.54 < np.mean(within < 1.0) < 0.82
        assert np.mean(within < 2.0) > 0.88
