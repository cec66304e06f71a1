"""The kernels of lattices agree with their definitions in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.corners import local_fit
from rigkit.native import kernels

pytestmark = pytest.mark.skipif(kernels("growth") is None, reason="the kernels are not built")

ROUNDING = 1e-7
"""Cells with enough neighbours: the normal equations of a cubic lose half of the digits of a pixel."""


def bent_lattice(rng: np.random.Generator, missing: float) -> np.ndarray:
    row, column = np.mgrid[:9, :11].astype(float)
    u = 800.0 + 20.0 * column + 3.0 * row + 0.2 * column**2 - 0.01 * column**2 * row
    v = 400.0 + 25.0 * row - 2.0 * column + 0.1 * row * column
    pixels = np.stack([u, v], axis=-1) + rng.normal(0.0, 0.1, (9, 11, 2))
    pixels[rng.random((9, 11)) < missing] = np.nan
    return pixels


@pytest.mark.parametrize("degree, ridge", [(1, (1e-8, 1e-6)), (2, (0.02, 1.0)), (3, (1e-3, 1e-2)), (3, (1e-8, 1e-6))])
@pytest.mark.parametrize("leave_out", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_local_fits(
    degree: int,
    ridge: tuple[float, float],
    leave_out: bool,
    missing: float,
    rng: np.random.Generator,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pixels = bent_lattice(rng, missing)
    cells = rng.random(pixels.shape[:2]) < 0.8
    settings = {"degree": degree, "ridge": ridge, "width": 1.3, "leave_out": leave_out}
    compiled = local_fit.fit_cells(pixels, cells, **settings)
    monkeypatch.setattr(local_fit, "kernels", lambda name: None)
    plain = local_fit.fit_cells(pixels, cells, **settings)
    clear = plain.support > 15
    assert clear.sum() > 60
    for name in ("pixels", "along_column", "along_row", "bend_column", "bend_row", "support", "gain"):
        one, two = getattr(compiled, name), getattr(plain, name)
        assert one.shape == two.shape
        assert np.abs(one - two)[clear].max() < ROUNDING * (1.0 + np.abs(two).max()), name
