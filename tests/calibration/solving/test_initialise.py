"""Initial values: the depths of boards along a curve that is not known yet."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.solving.initialise import EXPONENTS, _Depths
from rigkit.calibration.solving.radial_alignment import Alignment


def test_a_corner_beside_its_radial_line_determines_nothing() -> None:
    """As of a board whose corners are numbered otherwise: one corner got all of the weight, and digits cancelled."""
    rng = np.random.default_rng(0)
    views, corners = 12, 40
    board = np.repeat(rng.uniform(-100.0, 100.0, (1, 2, corners)), views, axis=0)
    tilt = rng.uniform(0.1, 0.5, (views, 2))
    offset = 3.0 * board / (1.0 + 1e-3 * (tilt[:, None] @ board))
    x, y = board[3, :, 7]
    offset[3, :, 7] = 300.0 * np.array([-y, x]) + 1e-7 * np.array([x, y])
    rows = np.zeros((views, 2, 3))
    rows[:, [0, 1], [0, 1]] = 1.0
    rho = np.hypot(offset[:, 0], offset[:, 1])
    depths = _Depths(Alignment(rows, tilt, np.ones((views, corners))), offset, rho / rho.max(), board)
    for exponents in EXPONENTS:
        curve = depths.curve(exponents)
        assert curve is None or all(np.isfinite(part).all() for part in curve)
