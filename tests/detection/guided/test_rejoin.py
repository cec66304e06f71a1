"""Parts of one board become one grid if the camera confirms it; parts of different boards do not."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.detection.detect import detect_boards
from rigkit.detection.guided.rejoin import rejoined
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.pairs import trihedral_pair
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import Panel

CAMERA = KannalaBrandt((800, 600), np.array([400.0, 400.0, 405.0, 295.0, -0.02, 0.002, 0.0, 0.0]))
BOARD = Board("b", 11, 8, 30.0, 30.0)
POSE = Rigid3(exp_so3(np.array([0.4, -0.5, 0.2])), np.array([-160.0, -90.0, 480.0]))


def part(
    columns: range, rows: range, *, moved: tuple[float, float] = (0.0, 0.0), tilt: float = 0.0, inverted: bool = False
) -> RefinedLattice:
    """Return the grid that these columns and rows of the board are found as, moved by squares within its plane and
    tilted out of it."""
    column, row = np.meshgrid(np.array(columns), np.array(rows))
    points = 30.0 * np.stack([column + moved[0], row + moved[1], np.zeros(column.shape)], axis=-1)
    pixels, valid = CAMERA.project((POSE @ Rigid3(exp_so3(np.array([0.0, tilt, 0.0])), np.zeros(3))).apply(points))
    assert valid.all()
    noise = np.random.default_rng(1).normal(0.0, 0.02, pixels.shape)
    ones = np.ones(column.shape)
    rising = (columns[0] + rows[0]) % 2 == int(inverted)
    return RefinedLattice(Lattice(pixels + noise, ones, rising), 0.02 * ones, ones, ones, ones)


def turned(item: RefinedLattice, turns: int) -> RefinedLattice:
    sigma, blur, residual, noise = (
        np.rot90(v, -turns) for v in (item.sigma_px, item.blur_px, item.residual, item.noise)
    )
    return RefinedLattice(item.lattice.turned(turns), sigma, blur, residual, noise)


@pytest.mark.parametrize("turns", range(4))
def test_parts_of_one_board_are_one_grid(turns: int) -> None:
    left, right = part(range(6), range(6)), part(range(8, 11), range(2, 8))
    (both,) = rejoined([turned(right, turns), left], [BOARD], CAMERA)
    assert both.lattice.size == BOARD.size and both.lattice.count == 54
    assert np.array_equal(both.lattice.pixels[:6, :6], left.lattice.pixels)
    assert np.array_equal(both.lattice.pixels[2:, 8:], right.lattice.pixels)
    assert both.lattice.rising == left.lattice.rising and np.isnan(both.sigma_px[0, 7])


@pytest.mark.parametrize(
    "other",
    [
        part(range(8, 11), range(2, 8), moved=(0.3, 0.2)),
        part(range(8, 11), range(2, 8), tilt=-0.2),
        part(range(8, 11), range(2, 8), inverted=True),
        part(range(9, 13), range(2, 8)),
        part(range(4, 9), range(2, 8), moved=(0.1, 0.1)),
    ],
    ids=["beside the grid", "another wall", "other colours", "too large", "the same place"],
)
def test_parts_of_different_boards_are_not_joined(other: RefinedLattice) -> None:
    assert len(rejoined([part(range(6), range(6)), other], [BOARD], CAMERA)) == 2


@pytest.mark.parametrize("seed", [4, 6, 7])
def test_a_slanted_pole_across_boards(seed: int) -> None:
    """Neither part of a board shows two of its borders, and corners at the pole's edge are placed 2 to 3 px off: with
    the other part its place is known, and from there what is covered."""
    rng = np.random.default_rng(seed)
    boards = [Board(f"p{k}", 11, 8, 30.0, 30.0) for k in range(3)]
    scene = trihedral_pair(boards, CAMERA, PoseType.GENERAL, rng, distance=(0.8, 1.1))
    pose = scene.cam1_from_world.inverse()
    middle = np.concatenate([board.points() for board in scene.boards]).mean(axis=0)
    at = scene.cam1_from_world.apply(pose.translation_mm + 0.75 * (middle - pose.translation_mm))
    pole = Panel(pose @ Rigid3(exp_so3(np.array([0.0, 0.0, 0.25])), at), 40.0, 4000.0, 0.2)
    image = render(
        scene.boards,
        CAMERA,
        scene.cam1_from_world,
        panels=scene.panels,
        occluders=[pole],
        optics=Optics(0.8, supersample=2),
        photometry=Photometry(noise_levels=3.0),
        rng=rng,
    )
    found = detect_boards(image, boards, camera=CAMERA)
    assert [(item.columns, item.rows) for item in found] == [(11, 8)] * 3
    truth = np.concatenate([board.see(CAMERA, scene.cam1_from_world)[0] for board in scene.boards])
    pixels = np.concatenate([item.pixels for item in found])
    off = np.linalg.norm(pixels[:, None] - truth, axis=2).min(axis=1)
    sigma = np.concatenate([item.sigma_px for item in found])
    assert len(pixels) > 210 and off.max() < 0.2
    assert np.sqrt((off**2 / (2.0 * sigma**2)).mean()) < 1.2
