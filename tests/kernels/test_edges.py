"""The compiled edge fit against its definition in numpy, on a rendered chessboard."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from kernels.reference import edges as reference

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.subpixel import edge_curvature, edge_fit
from rigkit.detection.subpixel.edge_curvature import line_curvature
from rigkit.detection.subpixel.edge_fit import EdgeFit, fit_edges
from rigkit.detection.subpixel.edge_model import Geometry, ends_of
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.photometry import Photometry, develop
from rigkit.synthetic.render import Optics, radiance
from rigkit.synthetic.scene import PlacedBoard

ROUNDING_PX = 5e-5
"""Both sum some hundred float32 products of 1e-7 relative error, in another order."""

ROUNDING_REL = 2e-3
"""Of sigma and residual: a pixel whose place on the window's edge is decided by rounding is one of two hundred."""

SIGMA_REL = 0.25
"""Of the errors of 48 corners, which chance makes a tenth larger or smaller."""

SAME_PAIRS_REL = 0.02
"""Of the sums over pairs of pixels, likewise: a pixel has a mirror image or not, and is one of a hundred."""


def both(*arguments: object, monkeypatch: pytest.MonkeyPatch, **options: object) -> tuple[EdgeFit, EdgeFit]:
    compiled = fit_edges(*arguments, **options)  # type: ignore[arg-type]
    monkeypatch.setattr(edge_fit, "fit_corners", reference.fit_corners)
    plain = fit_edges(*arguments, **options)  # type: ignore[arg-type]
    monkeypatch.undo()
    return compiled, plain


def scene(blur_px: float, noise: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return an image of a tilted board in a fisheye and its true corners (R, C, 2); some lie at the frame."""
    board = Board("b", 9, 7, 30.0, 30.0)
    camera = KannalaBrandt((320, 240), np.array([180.0, 180.0, 161.3, 118.7, -0.01, 0.0, 0.0, 0.0]))
    turn = exp_so3(np.array([0.5, -0.3, 0.4]))
    placed = PlacedBoard(board, Rigid3(turn, np.array([20.0, 10.0, 210.0]) - turn @ np.array([120.0, 90.0, 0.0])))
    optics = Optics(blur_px=blur_px)
    light = radiance((placed,), camera, Rigid3.identity(), optics=optics)
    image = np.asarray(develop(light, Photometry(noise_levels=noise), rng)).astype(np.float32)
    return image, placed.see(camera, Rigid3.identity())[0].reshape(7, 9, 2)


@pytest.mark.parametrize("papered", [False, True])
@pytest.mark.parametrize(("blur_px", "noise"), [(0.3, 0.0), (0.7, 2.0), (2.0, 5.0)])
def test_compiled_fit_is_the_numpy_fit(
    blur_px: float, noise: float, papered: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    image, truth = scene(blur_px, noise, rng)
    shape = fit_cells(truth, np.ones(truth.shape[:2], bool))
    sides, cells = np.stack([shape.along_column, shape.along_row], axis=1), np.ones(truth.shape[:2], bool)
    # Windows of some go less far to some sides.
    reach = np.where(rng.random((cells.size, 2, 2)) < 0.2, rng.uniform(0.2, 0.6, (cells.size, 2, 2)), np.nan)
    # Some ends have paper behind them.
    ends = ends_of(cells, cells)
    known = ends & papered & (rng.random(ends.shape) < 0.8)
    paper = np.where(known, rng.uniform(-1.2, 1.2, ends.shape), np.nan)
    gaps = shape.gaps() * np.where(known, rng.uniform(0.4, 1.1, ends.shape), 1.0)
    tilts = rng.normal(0.0, 0.05, ends.shape)
    geometry = Geometry(sides, shape.curvature(), gaps, ends, reach=reach, paper=paper, tilts=tilts)
    row, column = np.indices(truth.shape[:2])
    sign = np.where((row + column) % 2 == 0, 1.0, -1.0).ravel()
    start = truth.reshape(-1, 2) + rng.uniform(-0.3, 0.3, (truth.size // 2, 2))
    blur = np.full(len(start), 1.0)
    # All steps: whether the last one is still taken may hang on rounding.
    # Curvatures of some are fitted, too.
    loose = np.where(rng.random((len(start), 1)) < 0.5, 0.0, rng.uniform(1e-4, 3e-3, (len(start), 2)))
    # And of some the contrast is known, roughly.
    contrast = np.where(rng.random(len(start)) < 0.5, np.nan, 150.0)
    options = {"radius_px": 14.0, "iterations": 6, "converged_px": 0.0, "curvature_sigma": loose, "contrast": contrast}
    compiled, plain = both(image, start, geometry, sign, blur, monkeypatch=monkeypatch, **options)
    assert np.array_equal(compiled.valid, plain.valid)
    good = plain.valid & (np.abs(plain.contrast) > 20.0)
    assert good.sum() > 40
    assert np.abs(compiled.pixels - plain.pixels)[good].max() < ROUNDING_PX
    for name in ("sigma_px", "blur", "contrast", "residual", "noise"):
        ours, theirs = getattr(compiled, name)[good], getattr(plain, name)[good]
        assert np.abs(ours / theirs - 1.0).max() < ROUNDING_REL, name
    assert np.array_equal(compiled.pairs > 0.0, plain.pairs > 0.0)
    assert np.count_nonzero(plain.pairs[good, 0]) > 40
    for ours, theirs in ((compiled.pairs, plain.pairs), (compiled.products, plain.products)):
        assert np.abs(ours - theirs)[good].max() <= SAME_PAIRS_REL * theirs[good, :1].max()
    assert np.abs(compiled.used - plain.used).max() <= 2.0


def test_compiled_fit_of_single_squares_is_the_numpy_fit(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Eight samples a pixel both ways.
    v, u = (np.mgrid[:1600, :1920] + 0.5) / 8.0 - 0.5
    x, y = np.mod(0.98 * u + 0.12 * v, 40.0), np.mod(0.99 * v - 0.09 * u, 40.0)
    fine = np.where((x < 24.0) & (y < 24.0), 30.0, 200.0)
    image = cv2.GaussianBlur(fine.reshape(200, 8, 240, 8).mean(axis=(1, 3)), (0, 0), 1.2)
    image = (image + rng.normal(0.0, 2.0, image.shape)).astype(np.float32)
    along = np.linalg.inv(np.array([[0.98, 0.12], [-0.09, 0.99]]))
    cells = np.stack(np.meshgrid(np.arange(1, 5), np.arange(1, 4)), axis=-1).reshape(-1, 2)
    alone = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    corners = np.array([[0.0, 0.0], [24.0, 0.0], [24.0, 24.0], [0.0, 24.0]])
    truth = ((40.0 * cells[:, None] + corners) @ along.T).reshape(-1, 2)
    single = np.tile(alone, (len(cells), 1))
    count = len(truth)
    sides = np.broadcast_to(24.0 * along.T, (count, 2, 2))
    gaps, ends = np.full((count, 2, 2), 1e4), np.zeros((count, 2, 2), bool)
    geometry = Geometry(sides, np.zeros((count, 2)), gaps, ends, reach=np.full(gaps.shape, 0.3), single=single)
    arguments = (image, truth + rng.uniform(-0.4, 0.4, truth.shape), geometry, single.prod(axis=1), np.ones(count))
    options = {"radius_px": 14.0, "iterations": 8, "contrast": np.full(count, 85.0), "mirrored": False}
    compiled, plain = both(*arguments, monkeypatch=monkeypatch, **options)
    assert plain.valid.all()
    assert compiled.valid.all()
    assert np.abs(compiled.pixels - plain.pixels).max() < ROUNDING_PX
    assert np.abs(compiled.sigma_px / plain.sigma_px - 1.0).max() < ROUNDING_REL
    off = np.linalg.norm(compiled.pixels - truth, axis=1)
    assert np.sqrt(np.mean(off**2) / 2.0) == pytest.approx(np.sqrt(np.mean(compiled.sigma_px**2)), rel=SIGMA_REL)
    assert np.median(compiled.contrast) == pytest.approx(85.0, rel=0.02)


def test_same_pixels_whatever_the_cell(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Random cells, some slender, some along the rows, some beyond the image: the same windows, so the same fit."""
    image = rng.uniform(0.0, 255.0, (60, 80)).astype(np.float32)
    pixels = rng.uniform([-3.0, -3.0], [83.0, 63.0], (300, 2))
    angle, turn = rng.uniform(-np.pi, np.pi, 300), rng.uniform(0.2, 2.9, 300)
    angle[:60], turn[:30] = 0.0, 0.5 * np.pi
    length = rng.uniform(4.0, 40.0, (300, 2))
    sides = np.stack(
        [
            length[:, :1] * np.stack([np.cos(angle), np.sin(angle)], axis=1),
            length[:, 1:] * np.stack([np.cos(angle + turn), np.sin(angle + turn)], axis=1),
        ],
        axis=1,
    )
    geometry = Geometry(
        sides, rng.normal(0.0, 0.01, (300, 2)), rng.uniform(4.0, 30.0, (300, 2, 2)), rng.random((300, 2, 2)) < 0.3
    )
    # One step: on noise, later ones go wherever rounding sends them.
    options = {"radius_px": 9.0, "iterations": 1}
    arguments = (image, pixels, geometry, np.ones(300), rng.uniform(0.5, 2.0, 300))
    compiled, plain = both(*arguments, monkeypatch=monkeypatch, **options)
    assert np.array_equal(compiled.valid, plain.valid)
    assert plain.valid.sum() > 100
    assert np.abs(compiled.pixels - plain.pixels)[plain.valid].max() < 1e-3
    assert np.abs(compiled.residual / plain.residual - 1.0)[plain.valid].max() < 1e-4


def test_compiled_bends_are_the_numpy_ones(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """With gaps, corners not to be relied on, and corners alone on their line."""
    pixels = scene(0.7, 0.0, rng)[1] + rng.normal(0.0, 0.02, (7, 9, 2))
    pixels[rng.random((7, 9)) < 0.2] = np.nan
    pixels[3, [0, 1, 3, 4, 5, 6, 7, 8]] = np.nan
    cells = np.isfinite(pixels[..., 0])
    sigma = np.where(rng.random((7, 9)) < 0.1, np.nan, rng.uniform(1e-4, 0.1, (7, 9)))
    sides = rng.uniform(10.0, 30.0, (int(cells.sum()), 2))
    compiled = line_curvature(pixels, sigma, cells, sides)
    monkeypatch.setattr(edge_curvature, "line_curvatures", reference.line_curvatures)
    plain = line_curvature(pixels, sigma, cells, sides)
    for ours, theirs in zip(compiled, plain, strict=True):
        assert np.isfinite(theirs).all()
        assert np.abs(theirs).max() > 1e-4
        assert np.abs(ours - theirs).max() < 1e-9


def test_what_the_memory_held_before_does_not_matter(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind the last pixel of a window its last block has nothing, which decides nothing."""
    image, truth = scene(3.0, 2.0, rng)
    cells = np.ones(truth.shape[:2], bool)
    shape = fit_cells(truth, cells)
    sides = np.stack([shape.along_column, shape.along_row], axis=1)
    geometry = Geometry(sides, shape.curvature(), shape.gaps(), ends_of(cells, cells))
    sign = np.where(np.indices(cells.shape).sum(axis=0) % 2 == 0, 1.0, -1.0).ravel()
    rows = []
    for held in (0.0, 5.0, 1e13, np.nan):
        made: list[int] = []
        monkeypatch.setattr(
            np, "empty", lambda shape, dtype=float, held=held, made=made: made.append(1) or np.full(shape, held, dtype)
        )
        # One by one: a window covers what a smaller one before it has left.
        for alone in np.eye(cells.size, dtype=bool):
            corner = truth.reshape(-1, 2)[alone] + 0.2, geometry.of(alone), sign[alone], np.ones(1)
            fit = fit_edges(image, *corner, radius_px=18.0, iterations=8)
            rows.append([*fit.pixels[0], fit.sigma_px[0], fit.blur[0], fit.contrast[0]])
        assert made
    found = np.array(rows).reshape(4, cells.size, 5)
    assert np.isfinite(found[0]).mean() > 0.9
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_a_corner_of_no_known_place_or_shape_is_not_fitted(rng: np.random.Generator) -> None:
    image, truth = scene(0.7, 2.0, rng)
    shape = fit_cells(truth, np.ones(truth.shape[:2], bool))
    sides = np.stack([shape.along_column, shape.along_row], axis=1)
    start = truth.reshape(-1, 2).copy()
    start[0], start[1], sides[2], sides[3] = np.nan, np.inf, np.nan, -np.inf
    # No window is larger than the image, and no int64 holds this row.
    start[4] = 0.0, -1e19
    ends = np.zeros((len(start), 2, 2), bool)
    geometry = Geometry(sides, shape.curvature(), shape.gaps(), ends)
    fit = fit_edges(image, start, geometry, np.ones(len(start)), np.full(len(start), 0.7), radius_px=18.0, iterations=8)
    assert not fit.valid[:5].any()
    assert fit.valid[5:].sum() > 50


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38])
@pytest.mark.parametrize("share", [0.003, 0.5])
def test_pictures_without_numbers_are_read_inside_the_memory(
    value: float, share: float, rng: np.random.Generator
) -> None:
    image, truth = scene(0.7, 2.0, rng)
    image[rng.random(image.shape) < share] = value
    cells = np.ones(truth.shape[:2], bool)
    shape = fit_cells(truth, cells)
    sides = np.stack([shape.along_column, shape.along_row], axis=1)
    geometry = Geometry(sides, shape.curvature(), shape.gaps(), ends_of(cells, cells))
    start = truth.reshape(-1, 2)
    fit = fit_edges(image, start, geometry, np.ones(len(start)), np.ones(len(start)), radius_px=12.0, iterations=20)
    assert np.isfinite(fit.pixels[fit.valid]).all() and np.isfinite(fit.sigma_px[fit.valid]).all()
