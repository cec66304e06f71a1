"""The kernels that paint boards into the sub-samples of a tile agree with their definitions in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference.painting import cover, paint, reduced

from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.circles import Circles
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.kernels.painting import COVERED_PARTLY, COVERED_WHOLLY, NOT_COVERED, paint_surface, reduce_tile, tile_cover
from rigkit.synthetic.raycast import Chart, Surface, board_surface, charts_of, panel_surface
from rigkit.synthetic.scene import Panel, PlacedBoard

PER_PIXEL, SIDE = 4, 40
ROUNDING = 1e-4
"""Of a brightness up to 1: 1e-5 was found, of places in single precision."""
PINHOLE = Pinhole((2 * SIDE, 2 * SIDE), np.array([70.0, 71.5, 41.3, 38.2]))
FISHEYE = KannalaBrandt((2 * SIDE, 2 * SIDE), np.array([30.0, 31.0, 41.3, 38.2, -0.03, 0.004, 0.0, 0.0]))


def pose(turn: tuple[float, float, float], place: tuple[float, float, float]) -> Rigid3:
    return Rigid3(exp_so3(np.array(turn)), np.array(place))


HERE = Rigid3(np.eye(3), np.zeros(3))
TILTED = pose((0.5, 0.3, 0.2), (-130.3, -110.7, 400.0))
CHESSBOARD = Board("a", 6, 5, 50.0, 50.0)
BOARDS = {
    "chessboard": PlacedBoard(CHESSBOARD, TILTED),
    "white first": PlacedBoard(Board("a", 7, 4, 50.0, 40.0), TILTED, first_black=False),
    "far": PlacedBoard(CHESSBOARD, pose((0.1, 0.4, 0.0), (-200.0, -150.0, 3000.0))),
    "to the horizon": PlacedBoard(CHESSBOARD, pose((-1.5, 0.0, 0.0), (-120.0, 30.0, 60.0))),
    "seen from behind": PlacedBoard(CHESSBOARD, pose((np.pi, 0.2, 0.0), (-100.0, 100.0, 400.0))),
    "markers": PlacedBoard(Board("a", 6, 4, 50.0, 50.0, pattern=Charuco("DICT_4X4_50", 37.0)), TILTED),
    "circles": PlacedBoard(Board("a", 6, 5, 50.0, 45.0, pattern=Circles(diameter_mm=25.0)), TILTED),
    "white circles": PlacedBoard(
        Board("a", 6, 5, 50.0, 50.0, pattern=Circles(diameter_mm=25.0, inverted=True)), TILTED
    ),
}
SURFACES = {name: board_surface(board, HERE) for name, board in BOARDS.items()} | {
    "panel": panel_surface(Panel(pose((0.0, 0.2, 0.7), (20.0, -30.0, 300.0)), 150.0, 8.0, 0.7), HERE),
    "line": panel_surface(Panel(pose((np.pi / 2.0, 0.0, 0.0), (0.0, 0.0, 300.0)), 150.0, 150.0), HERE),
}


def charts(camera: Camera) -> list[Chart]:
    """Return four tiles of an image."""
    offsets = (np.arange((SIDE + 4) * PER_PIXEL) + 0.5) / PER_PIXEL - 2.5
    axes = [offsets, offsets + SIDE]
    return list(charts_of(camera, axes, axes, None, PER_PIXEL))


def painted(camera: Camera, surface: Surface, by_kernel: bool) -> list[np.ndarray]:
    """Return the sub-samples of the tiles, by the kernel or by its definition."""
    out = []
    for chart in charts(camera):
        out.append(np.full(chart.shape, 0.35, dtype=np.float32))
        if by_kernel:
            paint_surface(out[-1], chart.tile, surface.for_kernel())
        else:
            paint(out[-1], surface, chart, PER_PIXEL)
    return out


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "rim of a fisheye"])
@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_surfaces_are_painted_as_defined(camera: Camera, surface: Surface) -> None:
    ours, theirs = (np.array(painted(camera, surface, by_kernel)) for by_kernel in (True, False))
    assert np.abs(ours - theirs).max() < ROUNDING
    seen = np.unique(np.rint(100.0 * theirs))
    assert (len(seen) > 20) == (surface is not SURFACES["line"])


def test_tiles_are_covered_as_defined() -> None:
    """By a wall, which covers all but those at the rim of a fisheye wholly, too."""
    wall = panel_surface(Panel(pose((0.0, 0.2, 0.0), (0.0, 0.0, 300.0)), 9000.0, 9000.0), HERE)
    found = []
    for surface in (*SURFACES.values(), wall):
        for chart in (*charts(PINHOLE), *charts(FISHEYE)):
            found.append(tile_cover(chart.tile, surface.for_kernel()))
            assert found[-1] == cover(surface, chart)
    assert set(found) == {NOT_COVERED, COVERED_PARTLY, COVERED_WHOLLY}


def test_sub_samples_are_reduced_as_defined(rng: np.random.Generator) -> None:
    """In a tile cut off by the image's corner, too."""
    kernel = rng.uniform(0.0, 1.0, 7 * PER_PIXEL).astype(np.float32)
    fine = rng.uniform(0.0, 1.0, ((9 + 6) * PER_PIXEL, (5 + 6) * PER_PIXEL)).astype(np.float32)
    expected = reduced(fine, kernel, PER_PIXEL, (9, 5))
    np.testing.assert_allclose(reduce_tile(fine, kernel, PER_PIXEL, (9, 5)), expected, rtol=1e-5)
