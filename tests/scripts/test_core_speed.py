"""What `benchmark_core.py` compares gives equal results: a loop written from the paper, and the batched estimators."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import numpy as np
import pytest
from helpers.data import REPOSITORY

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.registry import AFFINE_METHODS, affines_from_directions
from rigkit.geometry.triangulation import triangulate_rays
from rigkit.relative_pose.solvers.planar import solve_planar_batch
from rigkit.relative_pose.solvers.pose import essential_from_pose

CORNERS = 200
LOOP_ABS = 1e-8
"""Both are exact algebra; F2UDIR amplifies rounding where a direction nearly follows its epipolar line."""


@pytest.fixture(scope="module")
def core() -> Any:
    sys.path.insert(0, str(REPOSITORY / "scripts"))
    return importlib.import_module("benchmark_core")


@pytest.mark.parametrize("count", [3, 6])
@pytest.mark.parametrize("method", AFFINE_METHODS)
def test_affinities(core: Any, method: str, count: int, rng: np.random.Generator) -> None:
    m = core.scene(rng, CORNERS)
    epipolar = EpipolarNormals.of_matches(m, essential_from_pose(core.POSE))
    d = core.noisy_directions(rng, m.A21, count)
    batched = affines_from_directions(d, method, epipolar=epipolar, min_conditioning=0.0).A21
    each = zip(d.image1, d.image2, epipolar.n1, epipolar.n2, strict=True)
    loop = np.array([core.loop_affine(method, *one) for one in each])
    both = np.isfinite(batched).all(axis=(1, 2)) & np.isfinite(loop).all(axis=(1, 2))
    assert both.mean() > 0.95
    # F2UDIR's conditioning here reaches 1e-5.
    assert np.quantile(np.abs(batched - loop)[both].max(axis=(1, 2)), 0.98) < LOOP_ABS


def test_normals(core: Any, rng: np.random.Generator) -> None:
    m = core.scene(rng, CORNERS)
    J1, J2 = core.jacobians(m, triangulate_rays(m.rays1, m.rays2, core.POSE)[0])
    loop = np.array([core.loop_normal(*one) for one in zip(J1, J2, m.A21, strict=True)])
    np.testing.assert_allclose(normals_from_affines(J1, J2, m.A21)[0], loop, atol=LOOP_ABS)


def test_planar(core: Any, rng: np.random.Generator) -> None:
    """The loop maximises the dual by golden section: near the optimum, never below it."""
    rows = rng.normal(size=(40, 12, 4))
    grams = np.swapaxes(rows, 1, 2) @ rows
    e, cost = solve_planar_batch(grams)
    loop = np.array([core.loop_planar(gram) for gram in grams])
    of_loop = np.einsum("ni,nij,nj->n", loop, grams, loop)
    assert np.all(cost <= of_loop * (1.0 + 1e-9))
    assert np.median(of_loop / cost) < 1.0 + 1e-6
    np.testing.assert_allclose(np.einsum("ni,nij,nj->n", e, grams, e), cost, rtol=1e-9)
