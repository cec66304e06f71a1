"""The kernel's step of the normal equations (Schur complement) is that of one dense system."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.kernels.linearise import schur_step


@pytest.mark.parametrize(("count", "views"), [(3, 1), (9, 7), (24, 40)])
@pytest.mark.parametrize("damping", [1e-13, 0.3])
def test_step_is_that_of_the_dense_system(count: int, views: int, damping: float, rng: np.random.Generator) -> None:
    """Parameters over twenty orders of magnitude; a view without any corner, and a global that none shows."""
    total, every = count + 6 * views, np.arange(views)
    rows = rng.normal(size=(total + 20, total)) * 10.0 ** rng.uniform(-10.0, 10.0, size=total)
    rows[:, [count - 1, *range(count, count + 6)]] = 0.0
    rows[:, 0] *= rng.normal(size=len(rows)) > 0.0
    normal, right = rows.T @ rows, rows.T @ rng.normal(size=len(rows))
    poses = normal[count:, count:].reshape(views, 6, views, 6)
    own = poses[every, :, every, :]
    poses[:] = 0.0
    poses[every, :, every, :] = own
    # Each pose is shown by rows of its own: that leaves the whole system positive definite.
    scale = np.sqrt(np.diag(normal).copy())
    scale[scale == 0.0] = 1.0
    normal[:count, count:] *= 0.1 / np.sqrt(views)
    normal[count:, :count] = normal[:count, count:].T
    gp = np.moveaxis(normal[:count, count:].reshape(count, views, 6), 1, 0)
    found = schur_step(normal[:count, :count], gp, own, right[:count], right[count:].reshape(views, 6), damping)
    assert found is not None
    step, added = np.concatenate([found[0], found[1].ravel()]), damping * scale**2
    scaled = (normal + np.diag(added)) / scale[:, None] / scale
    np.testing.assert_allclose(step * scale, np.linalg.solve(scaled, right / scale), rtol=1e-9, atol=1e-9)
    assert found[2] == pytest.approx(step @ (added * step + right), rel=1e-9)


def test_what_is_not_positive_definite_has_no_step() -> None:
    pose, gp, p = np.eye(6)[None], np.zeros((1, 2, 6)), np.zeros((1, 6))
    assert schur_step(np.array([[1.0, 2.0], [2.0, 1.0]]), gp, pose, np.ones(2), p, 1e-3) is None
    assert schur_step(np.eye(2), gp, -pose, np.ones(2), p, 1e-3) is None
    assert schur_step(np.eye(2), gp, pose, np.full(2, np.nan), p, 1e-3) is None
    assert schur_step(np.zeros((0, 0)), gp[:, :0], pose, np.zeros(0), p + 1.0, 0.0) is not None
