"""The kernel that reads the paper beyond the outermost squares agrees with its definition in numpy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.opencv import exact_interpolation
from kernels.reference import paper as reference

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.subpixel.edge_fit import fit_edges
from rigkit.detection.subpixel.edge_model import Geometry, ends_of
from rigkit.detection.subpixel.outer_squares import with_paper

ROUNDING = 1e-5
"""Relative, of numbers of about 1 and of px: brightness is read in single precision, 3e-5 grey levels."""

ROWS, COLUMNS, CELL_PX = 6, 8, 24.0


def board(rng: np.random.Generator, blur_px: float, margin: float) -> tuple[FloatArray, FloatArray]:
    """Return a board of cut squares on paper of brightness `margin`, out of focus, the right part of it outside the
    image, and its corners (R, C, 2)."""
    v, u = np.mgrid[:200, :210].astype(float)
    matrix, origin = np.array([[1.0, 0.12], [-0.08, 0.95]]), np.array([45.0, 40.0])
    x, y = np.moveaxis((np.stack([u, v], axis=-1) - origin) @ np.linalg.inv(CELL_PX * matrix).T, -1, 0)
    on_board = (x > -0.5) & (x < COLUMNS) & (y > -1.0) & (y < ROWS - 0.3)
    fine = np.where(on_board, np.where((np.floor(x) + np.floor(y)) % 2 == 0, 40.0, 190.0), margin)
    image = cv2.GaussianBlur(fine, (0, 0), blur_px) + rng.normal(0.0, 1.5, fine.shape)
    corners = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1) @ (CELL_PX * matrix).T + origin
    corners[(corners > np.array([208.0, 198.0])).any(axis=-1)] = np.nan
    return np.clip(image, 0.0, 255.0), corners


@exact_interpolation
@pytest.mark.parametrize("blur_px", [1.0, 2.5, 4.0])
@pytest.mark.parametrize("margin", [190.0, 110.0, 20.0])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_paper_and_gaps(blur_px: float, margin: float, dtype: type, rng: np.random.Generator) -> None:
    bright, corners = board(rng, blur_px, margin)
    image = np.rint(bright).astype(np.uint8) if dtype is np.uint8 else bright.astype(np.float32)
    known = np.isfinite(corners[..., 0])
    known[2, 3] = False
    shape = fit_cells(corners, known)
    geometry = Geometry(shape.sides, shape.curvature(), shape.gaps(), ends_of(known, known))
    sign = np.where(np.add.outer(np.arange(ROWS), np.arange(COLUMNS)) % 2 == 0, -1.0, 1.0)[known]
    fit = fit_edges(
        image, corners[known], geometry, sign, np.full(len(sign), blur_px), radius_px=12.0, iterations=4, mirrored=False
    )
    # The upper and the lower half as two boards.
    owner = np.nonzero(known)[0] // 3
    ours, theirs = (f(image, geometry, fit, sign, owner) for f in (with_paper, reference.with_paper))
    assert ours.paper is not None and theirs.paper is not None
    read = np.isfinite(theirs.paper)
    assert read.sum() >= 8 and (read | geometry.ends == geometry.ends).all()
    assert np.allclose(ours.paper, theirs.paper, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)
    assert np.allclose(ours.gaps, theirs.gaps, rtol=ROUNDING, atol=ROUNDING)


def test_a_board_without_ends_is_as_before() -> None:
    image, pixels = np.full((40, 40), 90, np.uint8), np.array([[20.0, 20.0]])
    sides, gaps = np.array([[[8.0, 0.0], [0.0, 8.0]]]), np.full((1, 2, 2), 8.0)
    geometry = Geometry(sides, np.zeros((1, 2)), gaps, np.zeros((1, 2, 2), np.bool_))
    fit = fit_edges(image, pixels, geometry, np.ones(1), np.ones(1), radius_px=8.0, iterations=1)
    out = with_paper(image, geometry, fit, np.ones(1), np.zeros(1, np.int64))
    assert out.paper is not None and np.isnan(out.paper).all() and (out.gaps == gaps).all()
