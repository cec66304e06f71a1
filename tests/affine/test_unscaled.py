"""DET3UDIR: the global minimum under the determinant, its sign, its eigenvalue, its scale."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import Corners, angles_deg, general_pairs, turned
from helpers.tolerances import EXACT_REL
from scipy.optimize import minimize

from rigkit.affine.normal import normals_from_affines
from rigkit.affine.registry import affines_from_directions
from rigkit.core.matches import DirectionPairs
from rigkit.geometry.rotation import unit

B = np.fliplr(np.diag([1.0, -1.0, -1.0, 1.0]))
SAME_COST_REL = 1e-9
BRUTE_FORCE_STARTS = 20


def random_directions(rng: np.random.Generator, n: int, k: int, noise_rad: float) -> tuple[DirectionPairs, np.ndarray]:
    """K unit directions all round and their images under random affinities of positive determinant, turned."""
    A21 = rng.normal(size=(n, 2, 2))
    A21[np.linalg.det(A21) < 0.0] = A21[np.linalg.det(A21) < 0.0][:, ::-1]
    angle = rng.uniform(0.0, 2.0 * np.pi, (n, k))
    d1 = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    d2 = unit(np.einsum("nij,nkj->nki", A21, d1))
    turn = noise_rad * rng.normal(size=(n, k))
    c, s = np.cos(turn), np.sin(turn)
    d2 = np.stack([c * d2[..., 0] - s * d2[..., 1], s * d2[..., 0] + c * d2[..., 1]], axis=-1)
    valid = np.ones((n, k), dtype=bool)
    return DirectionPairs(image1=d1, image2=d2, valid=valid, scaled=False, kinds=tuple(map(str, range(k)))), A21


def quadratic_form(directions: DirectionPairs, i: int) -> np.ndarray:
    u1, u2 = unit(directions.image1[i]), unit(directions.image2[i])
    rows = np.array([np.outer([-b[1], b[0]], a).ravel() for a, b in zip(u1, u2, strict=True)])
    return rows.T @ rows


def brute_force(S: np.ndarray, s: float, rng: np.random.Generator) -> float:
    """The least a^T S a over det A = s, A = rotation(p) diag(e^q, e^-q) rotation(r) sqrt(s), from many starts."""

    def cost(p: np.ndarray) -> float:
        def turn(x: float) -> np.ndarray:
            return np.array([[np.cos(x), -np.sin(x)], [np.sin(x), np.cos(x)]])

        a = (turn(p[0]) @ np.diag(np.exp([p[1], -p[1]])) @ turn(p[2])).ravel() * np.sqrt(s)
        return float(a @ S @ a)

    starts = rng.normal(size=(BRUTE_FORCE_STARTS, 3)) * [2.0, 1.0, 2.0]
    return min(minimize(cost, start, method="BFGS", options={"gtol": 1e-12}).fun for start in starts)


@pytest.mark.parametrize(("k", "noise_deg"), [(3, 25.0), (4, 2.0), (6, 25.0)])
def test_is_the_global_minimum(k: int, noise_deg: float, rng: np.random.Generator) -> None:
    n = 4
    directions, A_true = random_directions(rng, n, k, np.radians(noise_deg))
    s = np.linalg.det(A_true)
    found = affines_from_directions(directions, "DET3UDIR", determinant=s, min_conditioning=0.0)
    assert found.valid.all()
    np.testing.assert_allclose(np.linalg.det(found.A21), s, rtol=1e-8)
    for i in range(n):
        S = quadratic_form(directions, i)
        cost = found.A21[i].ravel() @ S @ found.A21[i].ravel()
        assert cost <= brute_force(S, s[i], rng) * (1.0 + SAME_COST_REL) + 1e-12


@pytest.mark.parametrize("k", [3, 5])
def test_agrees_with_the_eigenproblem(k: int, rng: np.random.Generator) -> None:
    """S a = mu B a: ours is the smallest positive mu. The largest, as one reads the appendix, is never right."""
    n = 300
    directions, _ = random_directions(rng, n, k, np.radians(10.0))
    found = affines_from_directions(directions, "DET3UDIR", determinant=np.ones(n), min_conditioning=0.0)
    smallest_right = largest_right = 0
    for i in range(n):
        values, vectors = np.linalg.eig(B @ quadratic_form(directions, i))
        order = np.argsort(np.real(values))
        candidates = []
        for j in order:
            a = np.real(vectors[:, j])
            det = a[0] * a[3] - a[1] * a[2]
            if det > 0.0:
                candidates.append(a / np.sqrt(det))
        assert len(candidates) == 2
        gap = [min(np.abs(found.A21[i].ravel() - sign * a).max() for sign in (1, -1)) for a in candidates]
        scale = np.abs(candidates[0]).max()
        smallest_right += gap[0] < 1e-6 * scale
        largest_right += gap[1] < 1e-6 * scale
    assert smallest_right == n
    assert largest_right == 0


def test_reversed_order_of_three_directions_still_has_an_answer(rng: np.random.Generator) -> None:
    """The null vector of three directions has a negative determinant then; the answer is the least-squares one."""
    n = 400
    directions, _ = random_directions(rng, n, 3, np.radians(25.0))
    null = []
    for i in range(n):
        null.append(np.linalg.eigh(quadratic_form(directions, i))[1][:, 0])
    determinant = np.linalg.det(np.array(null).reshape(-1, 2, 2))
    backwards = determinant < 0.0
    assert backwards.sum() > 20
    found = affines_from_directions(directions, "DET3UDIR", determinant=np.full(n, 2.0), min_conditioning=0.0)
    assert found.valid[backwards].all()
    np.testing.assert_allclose(np.linalg.det(found.A21[backwards]), 2.0, rtol=1e-8)
    a = unit(found.A21.reshape(n, 4))
    cost = np.array([a[i] @ quadratic_form(directions, i) @ a[i] for i in range(n)])
    assert (cost[backwards] > 1e-9).all()
    assert np.abs(cost[~backwards & (found.conditioning > 0.01)]).max() < 1e-14


def test_sign_maps_along_the_directions(rng: np.random.Generator) -> None:
    directions, A_true = random_directions(rng, 500, 4, np.radians(3.0))
    found = affines_from_directions(directions, "DET3UDIR", determinant=np.linalg.det(A_true), min_conditioning=0.0)
    along = np.einsum("nki,nij,nkj->n", directions.image2, found.A21, directions.image1)
    assert (along > 0.0).all()


def test_negative_determinants_are_invalid(rng: np.random.Generator) -> None:
    directions, _ = random_directions(rng, 5, 3, 0.0)
    found = affines_from_directions(directions, "DET3UDIR", determinant=np.array([1.0, -1.0, 0.0, np.nan, 2.0]))
    assert not found.valid[1:4].any()
    mirrored = DirectionPairs(
        image1=directions.image1, image2=directions.image2 * [1.0, -1.0], valid=directions.valid, scaled=True
    )
    assert not affines_from_directions(mirrored, "DET3UDIR").valid.any()


class TestDegenerate:
    def test_two_parallel_of_three(self, rng: np.random.Generator) -> None:
        directions, A_true = random_directions(rng, 50, 3, 0.0)
        first, second = directions.image1.copy(), directions.image2.copy()
        first[:, 2], second[:, 2] = -first[:, 0], -second[:, 0]
        parallel = DirectionPairs(image1=first, image2=second, valid=directions.valid, scaled=False)
        found = affines_from_directions(parallel, "DET3UDIR", determinant=np.linalg.det(A_true))
        assert not found.valid.any()
        assert np.nanmax(found.conditioning) < 1e-6

    def test_two_parallel_of_four_is_well(self, rng: np.random.Generator) -> None:
        directions, A_true = random_directions(rng, 50, 4, 0.0)
        first, second = directions.image1.copy(), directions.image2.copy()
        first[:, 2], second[:, 2] = -first[:, 0], -second[:, 0]
        four = DirectionPairs(image1=first, image2=second, valid=directions.valid, scaled=False, kinds=directions.kinds)
        found = affines_from_directions(four, "DET3UDIR", determinant=np.linalg.det(A_true), min_conditioning=0.02)
        assert found.valid.mean() > 0.7
        good = found.valid
        np.testing.assert_allclose(found.A21[good], A_true[good], atol=1e-6 * np.abs(A_true).max())


@pytest.fixture(scope="module")
def corners() -> Corners:
    return general_pairs(np.random.default_rng(4), 6, (40.0, 70.0))


class TestScale:
    """The determinant from the lengths: exact for area and ls, biased for the paper's squared mean."""

    @pytest.mark.parametrize("scale", ["area", "ls"])
    def test_exact_lengths_give_exact_normals(self, scale: str, corners: Corners) -> None:
        found = affines_from_directions(corners.directions(), "DET3UDIR", scale=scale)
        assert found.valid.all()
        np.testing.assert_allclose(found.A21, corners.A21, rtol=1e-7, atol=1e-9)
        normals, _ = normals_from_affines(corners.J1, corners.J2, found.A21)
        assert angles_deg(normals, corners.normals).max() < 1e-7

    def test_the_squared_mean_is_biased(self, corners: Corners) -> None:
        found = affines_from_directions(corners.directions(), "DET3UDIR", scale="sqmean")
        error = np.abs(np.linalg.det(found.A21) / np.linalg.det(corners.A21) - 1.0)
        assert np.median(error) > 0.02
        # Its shape is right all the same.
        ratio = found.A21 / np.sqrt(np.linalg.det(found.A21))[:, None, None]
        truth = corners.A21 / np.sqrt(np.linalg.det(corners.A21))[:, None, None]
        np.testing.assert_allclose(ratio, truth, rtol=1e-6, atol=1e-8)

    def test_the_squared_mean_is_exact_for_similarities(self, rng: np.random.Generator) -> None:
        directions, _ = random_directions(rng, 30, 3, 0.0)
        turn = np.array([[0.6, -0.8], [0.8, 0.6]]) * 1.7
        pairs = DirectionPairs(image1=directions.image1, image2=directions.image1 @ turn.T, valid=directions.valid)
        found = affines_from_directions(pairs, "DET3UDIR", scale="sqmean", min_conditioning=0.0)
        np.testing.assert_allclose(np.linalg.det(found.A21), 1.7**2, rtol=EXACT_REL)

    def test_bias_by_chords_is_gone_with_exact_lengths(self, corners: Corners) -> None:
        """One-sided chords, as in the paper, leave every length-based estimator wrong without any noise."""
        for method in ("DET3UDIR", "2SDIR", "3SDIR"):
            chords = affines_from_directions(corners.directions(chords=True), method)
            normals, _ = normals_from_affines(corners.J1, corners.J2, chords.A21)
            assert np.median(angles_deg(normals, corners.normals)) > 0.1
        udir = affines_from_directions(corners.directions(chords=True), "F3UDIR", epipolar=corners.epipolar)
        normals, valid = normals_from_affines(corners.J1, corners.J2, udir.A21)
        assert angles_deg(normals, corners.normals)[valid].max() < 1e-7


def test_error_is_proportional_to_the_noise(corners: Corners, rng: np.random.Generator) -> None:
    """Ten times less noise, ten times less error: nothing but the noise is in the estimate."""
    errors = []
    for sigma in (1.0, 0.1):
        found = affines_from_directions(turned(corners.directions(), sigma, rng), "DET3UDIR")
        normals, valid = normals_from_affines(corners.J1, corners.J2, found.A21)
        errors.append(np.median(angles_deg(normals, corners.normals)[valid]))
    assert 8.0 < errors[0] / errors[1] < 12.5
