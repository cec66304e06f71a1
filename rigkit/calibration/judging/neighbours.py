"""Correlation of the residuals of neighbouring corners: zero for noise, positive for errors of lens or board model."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.result import Calibration


def neighbour_correlation(c: Calibration) -> float:
    """Return the correlation of the residuals of inliers that are neighbours on their board; 0 if there are none."""
    corners = c.corners
    kept, grid = corners.kept, corners.grid
    columns, rows = (grid.max(axis=0) + 1).tolist()
    lattice, there = np.zeros((len(c.views) * rows * columns, 2)), np.zeros(len(c.views) * rows * columns)
    place = ((corners.view * rows + grid[:, 1]) * columns + grid[:, 0])[kept]
    lattice[place], there[place] = corners.residuals_px[kept], 1.0
    lattice, there = lattice.reshape(-1, rows, columns, 2), there.reshape(-1, rows, columns)
    squared = lattice[..., 0] ** 2 + lattice[..., 1] ** 2
    products, power = 0.0, 0.0
    for one, other in ((np.s_[:, :, 1:], np.s_[:, :, :-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        products += float((lattice[one] * lattice[other]).sum())
        power += 0.5 * float((squared[one] * there[other] + squared[other] * there[one]).sum())
    return products / power if power > 0.0 else 0.0
