"""Corners crossed by the edge of a shadow: the step of light is fitted, and they are as accurate as others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.detect import detect_boards
from rigkit.detection.guided.relit import relit
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.shadows import beside_shadows

SIZE_PX = (800, 600)
NEAR_PX = 12.0


def in_shadow(image: np.ndarray, through: np.ndarray, angle: float, left: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the image under a shadow whose edge goes through a pixel, and the distance of each pixel from that."""
    row, column = np.mgrid[: image.shape[0], : image.shape[1]]
    beyond = np.cos(angle) * (column - through[0]) + np.sin(angle) * (row - through[1])
    light = left + (1.0 - left) / (1.0 + np.exp(np.clip(-2.0 * beyond, -50.0, 50.0)))
    return np.clip(np.rint(image * light), 0, 255).astype(np.uint8), beyond


@pytest.mark.parametrize("pattern", [Chessboard(), Charuco("DICT_4X4_50", 21.0)])
@pytest.mark.parametrize("left", [0.25, 0.5])
def test_corners_under_the_edge_of_a_shadow_are_seen(pattern: Chessboard | Charuco, left: float) -> None:
    board = Board("b", 9, 6, 28.0, 28.0, pattern=pattern)
    offs, ratios, crossed = [], [], 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, lens="regular", board=board, size_px=SIZE_PX)
        truth = scene.truth()[0].pixels
        image = scene.render(blur_px=0.8, noise_levels=1.0, rng=rng).astype(np.float64)
        shaded, beyond = in_shadow(image, truth[rng.integers(len(truth))] + 1.0, rng.uniform(0.0, 2.0 * np.pi), left)
        (found,) = detect_boards(shaded, [board])
        apart = np.linalg.norm(found.pixels[:, None] - truth, axis=2)
        column, row = np.rint(truth).astype(int).clip(0, np.array(SIZE_PX) - 1).T
        near = np.abs(beyond[row, column]) < NEAR_PX
        crossed += int(np.count_nonzero(near))
        off, sigma = apart.min(axis=0), found.sigma_px[apart.argmin(axis=0)]
        seen = near & (off < 1.0)
        offs.append(off[seen])
        ratios.append(off[seen] / sigma[seen])
    off = np.concatenate(offs)
    # Of eight pictures 26 to 29 of 35 are found, with a median of 0.005 to 0.007 px; without even light 2 to 8 of 35,
    # with ten times that.
    assert len(off) > 0.65 * crossed
    assert np.median(off) < 0.02
    assert np.sqrt(np.mean(np.concatenate(ratios) ** 2) / 2.0) < 1.5


def test_slopes_of_the_light_are_no_shadows() -> None:
    row, column = np.mgrid[:120, :160]
    squares = np.where((row // 20 + column // 20) % 2 == 1, 200.0, 30.0)
    pixels = np.array([[79.5, 59.5], [99.5, 39.5]])
    sides = np.broadcast_to(20.0 * np.eye(2), (2, 2, 2))
    lateral, inner = np.full(2, 18.0), np.zeros(2, bool)
    sloping = (squares * (0.5 + column / 320.0)).astype(np.float32)
    assert not beside_shadows(sloping, pixels, sides, lateral, inner).any()
    shaded = (squares * np.where(column > 81, 0.25, 1.0)).astype(np.float32)
    assert beside_shadows(shaded, pixels, sides, lateral, inner).tolist() == [True, False]
    # Beyond the image there is nothing to see.
    assert not beside_shadows(shaded[:, :84], pixels, sides, lateral, inner).any()


def test_corners_fitted_as_well_as_usual_are_not_looked_at(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = Board("b", 9, 6, 28.0, 28.0)
    scene = one_board(rng, lens="regular", board=board, size_px=SIZE_PX)
    image = scene.render(blur_px=0.8, noise_levels=1.0, rng=rng)
    (found,) = detect_boards(image, [board])
    through = found.lattice()[2, 4] + 1.0
    shaded, _ = in_shadow(image.astype(np.float64), through, 0.7, 0.3)
    crossed = np.abs((found.pixels - through) @ (np.cos(0.7), np.sin(0.7))) < NEAR_PX
    assert np.count_nonzero(crossed) > 3
    uncertain = replace(found, sigma_px=np.where(crossed, 5.0, 1.0) * found.sigma_px)
    residual, sigma = np.full((6, 9), 3.0), found.sigma_px.reshape(6, 9)
    contrast = np.full((6, 9), 100.0)
    fits = RefinedLattice(Lattice(found.lattice(), contrast, False), sigma, np.full((6, 9), 0.8), residual, residual)
    with monkeypatch.context() as blind:
        blind.delattr("rigkit.detection.guided.relit.beside_shadows")
        assert relit(shaded, uncertain, fits) is uncertain
    residual[found.grid[crossed, 1], found.grid[crossed, 0]] = 30.0
    again = relit(shaded, uncertain, fits)
    assert np.median(again.sigma_px[crossed]) < 0.5 * np.median(uncertain.sigma_px[crossed])
