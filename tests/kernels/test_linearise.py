"""The kernels of the normal equations agree with their definition in numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from kernels.reference import linearise as reference

from rigkit.kernels.linearise import BoardViews, ViewSums

ROUNDING = 1e-12
"""Of the largest term: both add the same products, in another order."""
VIEWS, CORNERS, POINTS = 3, 70, 90


@pytest.mark.parametrize("loss_px", [0.0, 0.7])
@pytest.mark.parametrize(("parameters", "warps", "released"), [(4, 0, 0), (9, 11, 40), (10, 3, 0)])
def test_sums_are_as_defined(
    parameters: int, warps: int, released: int, loss_px: float, rng: np.random.Generator
) -> None:
    """More corners in a view than are worked on at a time; of no weight, or not projecting, NaN among them; released
    points and others; two blocks of views."""
    place = np.full(POINTS, -1)
    place[rng.permutation(POINTS)[:released]] = np.arange(released)
    seen: dict[str, Any] = {
        "rotation": rng.normal(size=(VIEWS, 3, 3)),
        "translation": rng.normal(size=(VIEWS, 3)),
        "table": rng.normal(size=(POINTS, 3)),
        "warp": rng.normal(size=(POINTS, 3, warps)),
        "place": place,
        "point": np.stack([rng.permutation(POINTS)[:CORNERS] for _ in range(VIEWS)]),
        "pixels": rng.normal(size=(VIEWS, CORNERS, 2)),
        "weight": rng.uniform(0.5, 2.0, (VIEWS, CORNERS)) * (rng.random((VIEWS, CORNERS)) < 0.9),
        "loss_px": loss_px,
        "lost_px": 50.0,
    }
    views = BoardViews.of(**seen, released=released)
    d_pixels_d_point, d_pixels_d_parameters = (rng.normal(size=(VIEWS, CORNERS, 2, k)) for k in (3, parameters))
    pixels, valid = rng.normal(size=(VIEWS, CORNERS, 2)), rng.random((VIEWS, CORNERS)) < 0.9
    d_pixels_d_point[~valid] = np.nan
    pixels[~valid] = np.nan
    theirs = reference.sums(seen, d_pixels_d_point, d_pixels_d_parameters, pixels, valid)
    lever_points = reference.placed(seen["rotation"], seen["translation"], seen["table"][seen["point"]])
    ours = ViewSums.of(views, parameters + warps + 7)
    for block in (slice(0, 2), slice(2, 3)):
        lever, points = views.placed(block.start, block.stop)
        for one, other in zip((lever, points), lever_points, strict=True):
            np.testing.assert_allclose(one, other[block].reshape(-1, 3).T, rtol=ROUNDING, atol=ROUNDING)
        d_point, d_parameters = (
            np.ascontiguousarray(np.moveaxis(by[block].reshape(-1, *by.shape[2:]), 0, -1))
            for by in (d_pixels_d_point, d_pixels_d_parameters)
        )
        u, v = pixels[block].reshape(-1, 2).T
        ours.add(block.start, d_point, d_parameters, (u, v, valid[block].ravel()), lever)
    assert (ours.valid == valid).all()
    for name, expected in theirs.items():
        found = np.moveaxis(ours.residuals, 0, -1) if name == "residuals" else getattr(ours, name)
        assert found.shape == expected.shape
        if expected.size:
            assert np.abs(found - expected).max() < ROUNDING * np.abs(expected).max(), name
