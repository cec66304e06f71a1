"""Planes through noisy nodes on a flat wall with a hole: their extent and their sigmas."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH
from rigkit.reconstruction.growing import surface as fitting
from rigkit.reconstruction.growing.grow import HALF_WIDTH
from rigkit.reconstruction.growing.surface import GrownSurface, NodeMeasurements, fit_surface

STEP = 3
SHAPE = (70, 90)
HOLE = np.s_[25:45, 30:60]
CAMERA = Pinhole((STEP * SHAPE[1], STEP * SHAPE[0]), np.array([300.0, 300.0, 134.5, 104.5]))
WALL = np.array([0.0002, -0.0001, 0.001])
"""m of m . X = 1: a wall a metre away."""
CENTRE = np.array([134.5, 104.5])
NOISE_PX, SLOPE_PX = 0.1, 2e4


def beside_the_hole() -> BoolArray:
    """Which nodes are as near to the hole as a patch reaches."""
    hole = np.zeros(SHAPE, np.uint8)
    hole[HOLE] = 1
    far = cv2.distanceTransform(1 - hole, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * STEP
    return np.asarray((far > 0.0) & (far <= HALF_WIDTH + STEP))


WINDOW = 15.0
"""Variance of a patch's window, px^2."""
BOWL = np.array([-3e-8, 5e-9, -2e-8])
"""Second derivatives (uu, uv, vv) of the inverse range by the pixel: those of a bowl with radii of 0.4 and 0.6 m."""


def fitted(
    times: FloatArray, rng: np.random.Generator, bend: FloatArray | None = None, roof: float = 0.0
) -> GrownSurface:
    """Return the planes where nodes err by `times` (R, C) what they state, NaN without a node; with second derivatives
    `bend` (uu, uv, vv) of a bowl around the middle of the image, or slopes `roof` of the inverse range away from it."""
    pixels = np.stack(np.meshgrid(*(STEP * np.arange(float(n)) for n in SHAPE[::-1])), axis=-1)
    rays, _ = CAMERA.unproject(pixels)
    frame = np.concatenate([rays[..., None, :], np.swapaxes(CAMERA.ray_jacobian(pixels), -1, -2)], axis=-2)
    sigma = NOISE_PX / SLOPE_PX * np.array([1.0, 0.1, 0.1])
    z = frame @ WALL + times[..., None] * sigma * rng.normal(size=(*SHAPE, 3))
    if bend is not None:
        second = np.array([[bend[0], bend[1]], [bend[1], bend[2]]])
        d = pixels - CENTRE
        z[..., 0] += 0.5 * np.einsum("...i,ij,...j->...", d, second, d) + 0.5 * WINDOW * np.trace(second)
        z[..., 1:] += d @ second
    across = pixels[..., 0] - CENTRE[0]
    z[..., 0] += roof * np.abs(across)
    z[..., 1] += roof * np.sign(across)
    z[HOLE] = np.nan
    return fit_surface(
        NodeMeasurements(
            z=z,
            covariance=np.broadcast_to(np.diag(sigma**2), (*SHAPE, 3, 3)).copy(),
            frame=frame,
            slope=np.full(SHAPE, SLOPE_PX),
            swept=np.zeros(SHAPE, dtype=bool),
            offset=np.zeros((*SHAPE, 2)),
            window=np.full(SHAPE, WINDOW),
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


def test_a_curved_surface_is_not_too_far_by_what_bends_within_the_windows() -> None:
    """As a plane through all nodes around would be."""
    off, sigmas = [], []
    pixels = np.stack(np.meshgrid(*(STEP * np.arange(float(n)) for n in SHAPE[::-1])), axis=-1)
    rays, _ = CAMERA.unproject(pixels)
    d = pixels - CENTRE
    true = np.sum(WALL * rays, axis=-1)
    true += 0.5 * (BOWL[0] * d[..., 0] ** 2 + 2.0 * BOWL[1] * d[..., 0] * d[..., 1] + BOWL[2] * d[..., 1] ** 2)
    for seed in range(4):
        surface = fitted(np.ones(SHAPE), np.random.default_rng(seed), BOWL)
        error = np.sum(surface.plane * rays, axis=-1) - true
        inner = np.isfinite(error) & ~beside_the_hole()
        inner[:6] = inner[-6:] = inner[:, :6] = inner[:, -6:] = False
        off.append(error[inner])
        sigmas.append(np.sqrt(np.einsum("...i,...ij,...j->...", rays, surface.covariance, rays))[inner])
    error, sigma = np.concatenate(off), np.concatenate(sigmas)
    # A plane is off by half the curvature times the variance of all windows: of nodes in a square, and of each.
    nodes = round(2.0 * HALF_WIDTH / STEP)
    of_plane = 0.5 * (BOWL[0] + BOWL[2]) * (STEP**2 * nodes * (nodes + 1.0) / 3.0 + WINDOW)
    assert np.median(sigma) < 0.4 * abs(of_plane) and abs(np.median(error)) < 0.25 * abs(of_plane)
    # Normals of a bowl in perspective do not change evenly, which counts as noise.
    assert 0.54 < np.mean(np.abs(error) < sigma) < 0.9
    assert np.mean(np.abs(error) < 2.0 * sigma) > 0.88


def shares(monkeypatch: pytest.MonkeyPatch, bend: FloatArray | None = None, roof: float = 0.0) -> FloatArray:
    """Return the shares (R, C) of curvatures that move the planes of `fitted`."""
    seen, true = [], fitting._share_of_curvature

    def spied(*args: Any) -> FloatArray:
        seen.append(true(*args))
        return seen[-1]

    with monkeypatch.context() as patched:
        patched.setattr(fitting, "_share_of_curvature", spied)
        fitted(np.ones(SHAPE), np.random.default_rng(1), bend, roof)
    return np.asarray(seen[-1])


@pytest.mark.parametrize("turned", [False, True])
def test_curvature_is_what_neighbours_agree_on_noise_and_creases_are_none(
    monkeypatch: pytest.MonkeyPatch, *, turned: bool
) -> None:
    """All windows along a crease look alike, but not those across it."""
    away = np.ones(SHAPE, dtype=bool)
    away[20:50, 25:65] = False
    assert np.median(shares(monkeypatch, 2.0 * BOWL)[away]) > 0.9
    assert np.mean(shares(monkeypatch)[away]) < 0.15
    crease = shares(monkeypatch, roof=1e-6 * (-1.0 if turned else 1.0))[:, SHAPE[1] // 2 - 3 : SHAPE[1] // 2 + 3]
    assert np.max(crease[:20]) < 0.2


def test_nodes_in_a_line_do_not_determine_a_curvature(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "MIN_NODE_SUPPORT", 0.5 * fitting.MIN_NODE_SUPPORT)
    seen, true = [], fitting._curvatures

    def spied(*args: Any) -> Any:
        seen.append(true(*args))
        return seen[-1]

    monkeypatch.setattr(fitting, "_curvatures", spied)
    row = np.where(np.arange(SHAPE[0])[:, None] == 10, 1.0, np.nan) * np.ones(SHAPE)
    alone = fitted(row, np.random.default_rng(2))
    assert np.isfinite(alone.plane[10, 5:-5]).all()
    assert not seen[-1].shift.any() and not seen[-1].covariance.any()


def test_planes_at_right_angles_disagree_by_right_angles() -> None:
    """Not by the sine: normals of what lies between edges often differ by much."""
    lag, variance = 4, 1e-4
    planes = np.eye(3)[(np.indices((20, 20)) // lag).sum(axis=0) % 2]
    covariance = np.broadcast_to(variance * np.eye(3), (20, 20, 3, 3))
    scale = fitting._disagreement(planes, covariance, np.ones((20, 20)), lag, fitting.SLOPES)
    # Each normal has two components of this variance, and so has each angle, of two normals.
    expected = 0.5 * np.pi / np.sqrt(4.0 * variance) * np.sqrt(2.0) / MEDIAN_OF_RAYLEIGH
    np.testing.assert_allclose(scale, expected, rtol=0.11)


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
