"""The kernel of the pixels that boards covered agrees with its definition in numpy."""

from __future__ import annotations

import numpy as np

from rigkit.kernels.coverage import covered_pixels


def test_covered_pixels_are_as_defined(rng: np.random.Generator) -> None:
    """Boards of several sizes, each bent a little by its perspective: whole, a single row, cut off along a diagonal,
    that diagonal alone, and a single corner, which covers no more than itself."""
    views = []
    for columns, rows, part in ((9, 6, 0), (4, 3, 0), (7, 1, 0), (1, 5, 0), (8, 7, 1), (6, 6, 2), (1, 1, 0)):
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), axis=-1).reshape(-1, 2)
        along = grid[:, 0] - grid[:, 1]
        grid = grid[(along >= 0) if part == 1 else (along == 0) if part == 2 else slice(None)]
        affine, place = rng.normal(0.0, 12.0, (2, 2)), rng.uniform(100.0, 500.0, 2)
        views.append((grid, place + grid @ affine.T + rng.normal(0.0, 0.5, grid.shape)))
    pixels = np.concatenate([rng.uniform(0.0, 600.0, (4000, 2)), views[-1][1]])
    expected = np.zeros(len(pixels), dtype=bool)
    for grid, corners in views:
        off = grid - grid.mean(axis=0)
        sides = np.linalg.norm(np.linalg.pinv(off, rcond=1e-9) @ (corners - corners.mean(axis=0)), axis=1)
        distance = np.linalg.norm(pixels[:, None] - corners, axis=-1).min(axis=1)
        expected |= distance <= 0.7 * sides.max()
    grids, corners = (np.concatenate(part) for part in zip(*views, strict=True))
    counts = np.array([len(grid) for grid, _ in views])
    assert 0.02 < expected.mean() < 0.9
    assert (covered_pixels(grids, corners, counts, 0.7, pixels) == expected).all()
