"""Derivatives by central differences, with which every analytic derivative is compared."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

STEP_REL = 1e-6
"""Best for float64 (truncation error ~ step^2, rounding error ~ 1e-16 / step), measured on fisheye cameras."""


def central_difference(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, steps: np.ndarray | float | None = None
) -> np.ndarray:
    """Return d function / d x by central differences: function (..., n) -> (..., m) gives (..., m, n).

    `steps` (n,) or a number: absolute steps; by default STEP_REL times the magnitude of each entry, at least 1.
    """
    x = np.asarray(x, dtype=np.float64)
    columns = []
    for k in range(x.shape[-1]):
        if steps is None:
            h = STEP_REL * np.maximum(np.abs(x[..., k]), 1.0)
        else:
            h = np.broadcast_to(np.asarray(steps, dtype=np.float64), x.shape[-1:])[k]
        up, down = x.copy(), x.copy()
        up[..., k] += h
        down[..., k] -= h
        # The actual step, after rounding.
        taken = up[..., k] - down[..., k]
        columns.append((function(up) - function(down)) / np.expand_dims(taken, -1))
    return np.stack(columns, axis=-1)
