"""The Cramer-Rao bound of corners against its integral and against another model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detection_bench.corner_bound import corner_information, position_bound
from detection_bench.scenes import BENCH_PHOTOMETRY, BenchScene, bench_camera, one_board
from scipy.optimize import least_squares
from scipy.special import erf

from rigkit.core.boards import Board
from rigkit.detection.subpixel.edge_fit import ROUNDING_VARIANCE
from rigkit.geometry.rigid3 import Rigid3
from rigkit.synthetic.photometry import develop
from rigkit.synthetic.render import Optics
from rigkit.synthetic.scene import PlacedBoard

ANALYTIC_REL = 0.02
"""The integrals leave out the light's gradient (12 per cent over the image) and that a cell is whole pixels wide."""

OTHER_MODEL_REL = 0.03
"""The other model's pixel is a Gaussian, not a box, and it does not know of the neighbouring corners' edges."""


def upright(square_px: float) -> BenchScene:
    """A board seen straight on, rows along the image's rows, in its middle."""
    camera = bench_camera("regular")
    board = Board("b", 6, 5, 30.0, 30.0)
    depth = float(camera.parameters[0]) * 30.0 / square_px
    shift = np.array([-75.0, -60.0, depth])
    return BenchScene("upright", (PlacedBoard(board, Rigid3(np.eye(3), shift)),), (), camera)


@pytest.mark.parametrize("blur_px", [0.7, 1.5])
def test_information_of_perpendicular_lines(blur_px: float) -> None:
    """Moving a corner along u moves one line of length L, a step of height h. In noise of variance 1 its information is
    h^2 / (2 sqrt(pi) s) times L less what is lost at the other line, where the step changes sign. s^2 is the variance
    of blur and pixel together."""
    square_px = 24.0
    scene = upright(square_px)
    (information,) = corner_information(scene, blur_px)
    s = np.hypot(blur_px, np.sqrt(1.0 / 12.0))
    light = develop(np.ones((480, 640)), replace(BENCH_PHOTOMETRY, bits=16)) / 257.0
    (truth,) = scene.truth()
    column, row = np.rint(truth.pixels).astype(int).T
    height = light[row, column] * (0.85 - 0.06)
    x = np.linspace(-0.5 * square_px, 0.5 * square_px, 4001)
    length = np.trapezoid(erf(x / (np.sqrt(2.0) * s)) ** 2, x)
    expected = height**2 * length / (2.0 * np.sqrt(np.pi) * s)
    for axis in (0, 1):
        np.testing.assert_allclose(information[:, axis, axis], expected, rtol=ANALYTIC_REL)


def test_bound_of_another_model_of_the_same_corner() -> None:
    """Nine parameters of a formula fitted to the noise-free picture: their covariance in least squares."""
    square_px, blur_px, noise = 16.0, 1.0, 4.0
    scene = upright(square_px)
    (information,) = corner_information(scene, blur_px)
    (truth,) = scene.truth()
    picture = develop(scene.radiance(Optics(blur_px)), replace(BENCH_PHOTOMETRY, bits=16)) / 257.0
    middle = 14
    x, y = truth.pixels[middle]
    u, v = np.meshgrid(np.arange(640) - x, np.arange(480) - y)
    cell = np.maximum(np.abs(u), np.abs(v)) <= 0.5 * square_px
    u, v, levels = u[cell], v[cell], picture[cell]

    def model(p: np.ndarray) -> np.ndarray:
        du, dv = u - p[0], v - p[1]
        across = [(du + p[2] * dv) / np.hypot(1.0, p[2]), (dv + p[3] * du) / np.hypot(1.0, p[3])]
        steps = [erf(d / (np.sqrt(2.0) * p[4])) for d in across]
        return np.asarray((1.0 + p[7] * u + p[8] * v) * (p[5] + p[6] * steps[0] * steps[1]))

    near, far = levels[(u < -3.0) & (v < -3.0)].mean(), levels[(u < -3.0) & (v > 3.0)].mean()
    start = np.array([0.0, 0.0, 0.0, 0.0, blur_px, 0.5 * (near + far), 0.5 * (near - far), 0.0, 0.0])
    fit = least_squares(lambda p: model(p) - levels, start, jac="3-point", x_scale="jac")
    assert np.abs(fit.fun).max() < 1.5
    assert np.abs(fit.x[:2]).max() < 1e-3
    normal = fit.jac.T @ fit.jac
    # Lines turn by px at the next corner here, by slope there; s^2 is the variance of blur and pixel together.
    scale = np.array([1.0, 1.0, 1.0 / square_px, 1.0 / square_px, blur_px / fit.x[4]])
    same = np.diag(normal)[[0, 1, 3, 2, 4]] * scale**2
    np.testing.assert_allclose(np.diag(information[middle])[:5], same, rtol=OTHER_MODEL_REL)
    covariance = np.linalg.inv(normal)[:2, :2] * (noise**2 + ROUNDING_VARIANCE)
    bound = position_bound(information, noise)[middle]
    np.testing.assert_allclose(np.trace(bound), np.trace(covariance), rtol=OTHER_MODEL_REL)


def test_bound_follows_noise_and_contrast(rng: np.random.Generator) -> None:
    scene = one_board(rng, size_px=(320, 240), board=Board("b", 6, 5, 30.0, 30.0))
    (information,) = corner_information(scene, 0.7)
    assert np.isfinite(information).all()
    assert np.allclose(information, np.swapaxes(information, 1, 2))
    one, two = (position_bound(information, noise) for noise in (2.0, 4.0))
    np.testing.assert_allclose(two / one, (16.0 + ROUNDING_VARIANCE) / (4.0 + ROUNDING_VARIANCE))
    (placed,) = scene.boards
    half = replace(scene, boards=(replace(placed, white=0.455, black=0.06),))
    (less,) = corner_information(half, 0.7)
    ratio = [np.trace(part, axis1=1, axis2=2) for part in (position_bound(less, 2.0), one)]
    np.testing.assert_allclose(ratio[0] / ratio[1], 4.0, rtol=0.1)
