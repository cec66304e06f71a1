"""Boards that touch or overlap, nearly in line: each is one board, and their common border has no corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from detection_bench.scenes import CONDITIONS, three_boards
from detection_bench.score import FoundBoard, score
from helpers.detection_scenes import SIZE_PX, Scene, regular
from scipy.spatial import cKDTree

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.checks.discontinuity import may_be_discontinuous, split_at_discontinuities, without_outliers
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.photometry import develop
from rigkit.synthetic.scene import PlacedBoard

WRONG_PX = 0.3
"""A corner this far from where it is and more than 5 of its sigmas is another thing."""

SIDE_MM = 20.0


def side_by_side(
    sizes: Sequence[tuple[int, int]], overlap: float, shift: float, turn_rad: float, *, ratio: float = 1.0
) -> Scene:
    """Return two boards without margins, the second to the right of the first and seen aslant.

    overlap : columns of the first that the second covers, in squares.
    shift : of the second downwards, in squares, beside the first's middle.
    turn_rad : of the second in its plane.
    ratio : of its squares to those of the first.
    """
    one, two = (Board(n, c, r, s, s) for n, (c, r), s in zip("ab", sizes, (SIDE_MM, ratio * SIDE_MM), strict=True))
    view = exp_so3(np.array([0.2, -0.25, 0.3]))
    apart = 0.5 * ((one.columns + 1) * SIDE_MM + (two.columns + 1) * ratio * SIDE_MM) - overlap * SIDE_MM
    placed = []
    for board, sign, turn in ((one, -0.5, 0.0), (two, 0.5, turn_rad)):
        rotation = view @ exp_so3(np.array([0.0, 0.0, turn]))
        # The second lies a millimetre before the first where they overlap.
        middle = np.array([0.0, 0.0, 560.0]) + view @ (sign * np.array([apart, shift * SIDE_MM, -1.0]))
        half = 0.5 * np.array([(board.columns - 1), (board.rows - 1), 0.0]) * board.square_x_mm
        placed.append(PlacedBoard(board, Rigid3(rotation, middle - rotation @ half), 0.0))
    return Scene(tuple(placed), regular(), Rigid3.identity())


def wrong(found: Sequence[BoardDetection], scene: Scene) -> int:
    """Return how many corners are not where the board that most of theirs belong to has them, counted as it counts."""
    truth = scene.truth()
    trees = [cKDTree(pixels) for _, pixels in truth]
    out = 0
    for item in found:
        near = [(tree.query(item.pixels)[0] < 1.0).sum() for tree in trees]
        mine = int(np.argmax(near))
        distance, index = trees[mine].query(item.pixels)
        bad = distance > np.maximum(WRONG_PX, 5.0 * item.sigma_px)
        best = len(bad)
        for quarter in range(4):
            # The grid of a part starts anywhere in its board's.
            turned = item.turned(quarter)
            exact, own = {tuple(p): g for p, g in zip(item.pixels, truth[mine][0][index], strict=True)}, turned.grid
            off = np.array([exact[tuple(p)] for p in turned.pixels]) - own
            other = np.array([dict(zip(map(tuple, item.pixels), bad, strict=True))[tuple(p)] for p in turned.pixels])
            typical = np.median(off, axis=0)
            best = min(best, int((other | (off != typical).any(axis=1)).sum()))
        out += best
    return out


SCENES = {
    "touching in line": (((8, 6), (7, 6)), 0.0, 1.06, 0.01, 1.0),
    "touching, moved by three squares": (((8, 6), (7, 6)), 0.0, 3.06, 0.02, 1.0),
    "larger squares": (((7, 5), (8, 5)), 0.17, 0.07, 0.055, 1.1),
    "smaller squares": (((7, 5), (8, 5)), 0.35, -2.53, 0.042, 0.9),
    "half a square hidden": (((7, 5), (8, 5)), 0.5, -2.43, 0.048, 1.0),
    "a square hidden": (((8, 6), (7, 6)), 1.1, -2.02, 0.034, 1.0),
    "a neck of two squares": (((7, 6), (7, 6)), 0.84, -3.52, 0.0, 1.0),
    "a border taken for a row": (((9, 6), (6, 6)), 1.47, 0.9, 0.037, 1.0),
    "a border beside a row": (((9, 6), (6, 6)), 0.84, -0.92, -0.037, 1.0),
}
"""Sizes, squares hidden, shift, turn, and ratio of the squares."""


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("sizes_known", [False, True])
def test_boards_nearly_in_line_are_two(name: str, sizes_known: bool, rng: np.random.Generator) -> None:
    sizes, overlap, shift, turn, ratio = SCENES[name]
    scene = side_by_side(sizes, overlap, shift, turn, ratio=ratio)
    found = detect_boards(scene.image(rng), [placed.board for placed in scene.boards] if sizes_known else None)
    assert len(found) == 2
    assert wrong(found, scene) == 0
    assert sum(len(item.grid) for item in found) >= 0.85 * sum(len(p) for _, p in scene.truth()) - 6


def sheet(pixels: np.ndarray, sigma_px: float = 0.01) -> RefinedLattice:
    known = np.isfinite(pixels[..., 0])
    values = np.where(known, 1.0, np.nan)
    lattice = Lattice(pixels, 100.0 * values, True)
    return RefinedLattice(lattice, sigma_px * values, 0.8 * values, 2.0 * values, 2.0 * values)


def smooth(columns: int, rows: int, bend: float = 0.0) -> np.ndarray:
    """Return corners 20 px apart, seen aslant and bent as by a wide lens."""
    x, y = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
    depth = 1.0 + 0.01 * x - 0.02 * y
    place = np.stack([20.0 * x / depth, 20.0 * y / depth], axis=-1)
    away = place - 100.0
    return place * 1.0 + bend * away * (away**2).sum(axis=-1, keepdims=True) / 100.0**2


def test_a_sheet_is_cut_where_it_jumps_and_nowhere_else(rng: np.random.Generator) -> None:
    plain = smooth(15, 6, -0.005) + rng.normal(0.0, 0.01, (6, 15, 2))
    assert len(split_at_discontinuities(sheet(plain))) == 1
    for moved in ([0.0, 2.0], [2.0, 0.0], [0.0, -2.0]):
        two = plain.copy()
        two[:, 8:] += moved
        parts = split_at_discontinuities(sheet(two))
        assert [part.lattice.trimmed().size for part in parts] == [(8, 6), (7, 6)]
        turned = split_at_discontinuities(sheet(two.swapaxes(0, 1)[..., ::-1]))
        assert [part.lattice.trimmed().size for part in turned] == [(6, 8), (6, 7)]
        # A column on the seam continues neither side.
        two[:, 7] += 0.5 * np.array(moved) * rng.choice([-1.0, 1.0], (6, 1))
        assert [part.lattice.trimmed().size for part in split_at_discontinuities(sheet(two))] == [(7, 6), (7, 6)]


@pytest.mark.parametrize("at", [7.0, 7.5])
@pytest.mark.parametrize("bend", [0.04, 0.2])
def test_a_crease_is_no_seam_unless_there_must_be_one(at: float, bend: float, rng: np.random.Generator) -> None:
    """A folded sheet bends at the crease, but its sides meet there, on a corner or within a square."""
    creased = smooth(14, 7) + rng.normal(0.0, 0.01, (7, 14, 2))
    creased += bend * 20.0 * np.maximum(np.arange(14.0) - at, 0.0)[:, None] * [0.6, 0.8]
    assert len(split_at_discontinuities(sheet(creased))) == 1
    assert len(split_at_discontinuities(sheet(creased), several=True)) == 2


def test_parts_of_a_board_that_something_covers_stay_together(rng: np.random.Generator) -> None:
    covered = smooth(14, 8, -0.05) + rng.normal(0.0, 0.01, (8, 14, 2))
    covered[:4, 5:7] = np.nan
    covered[4:, 6:9] = np.nan
    assert len(split_at_discontinuities(sheet(covered))) == 1


def test_only_suspicious_lattices_need_the_full_search() -> None:
    whole = sheet(smooth(8, 6))
    assert not may_be_discontinuous(whole, SIZE_PX)
    hidden = whole.without(np.add.outer(np.arange(6), np.arange(8)) < 3)
    assert may_be_discontinuous(hidden, SIZE_PX)
    # What the frame cuts off is not missing.
    moved = hidden.lattice.pixels - [50.0, 50.0]
    assert not may_be_discontinuous(replace(hidden, lattice=replace(hidden.lattice, pixels=moved)), SIZE_PX)
    uneven = whole.residual.copy()
    uneven[:, 3] *= 1.5
    assert may_be_discontinuous(replace(whole, residual=uneven), SIZE_PX)


def test_a_sheet_bent_like_a_wave_is_not_searched() -> None:
    """It is no two smooth surfaces, and the search alone would cut it."""
    bent = smooth(15, 7)
    bent[..., 1] += np.sin(np.arange(15) * (2.0 * np.pi / 6.0))
    assert len(split_at_discontinuities(sheet(bent))) > 1
    assert not may_be_discontinuous(sheet(bent), SIZE_PX)


def test_what_fits_badly_goes_where_it_lies_aside_and_else_stays(rng: np.random.Generator) -> None:
    pixels = smooth(9, 6) + rng.normal(0.0, 0.01, (6, 9, 2))
    pixels[:, 8] += [3.0, 0.0]
    item = sheet(pixels)
    assert without_outliers(item, SIZE_PX) is item, "no corner fits badly"
    residual = item.residual.copy()
    residual[:, 8] *= 3.0
    residual[2, 4] *= 3.0
    kept = without_outliers(replace(item, residual=residual), SIZE_PX).lattice
    assert kept.size == (8, 6)
    assert kept.known.all()
    loose = replace(item, residual=residual, sigma_px=np.full((6, 9), 1.0))
    assert without_outliers(loose, SIZE_PX).lattice.known.all()


def test_rows_under_the_edge_of_a_shadow_are_of_the_board() -> None:
    """They fit badly, two outer rows at once, and what the rest says of the outermost is only nearly so."""
    scene = three_boards(np.random.default_rng(0))
    optics, photometry = CONDITIONS["shadow"]
    image = np.asarray(develop(scene.radiance(optics), photometry, np.random.default_rng(0)))
    total = score(scene, [FoundBoard.of(item) for item in detect_boards(image)])
    assert total.recall == 1.0
