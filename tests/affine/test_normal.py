"""Normals from affinities: optimal against brute force, many views, predicted errors against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import FISHEYE, REGULAR, Corners, angles_deg, general_pairs, see, special_boards, turned

from rigkit.affine.affinities import DirectionNoise
from rigkit.affine.normal import affines_from_normals, estimate_normals, normals_from_affines
from rigkit.affine.registry import affines_from_directions
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit

EXACT_DEG = 1e-9
PREDICTED = 0.10
"""Predicted over measured rms angle; medians over corners, 300 trials each (4 % standard error a corner)."""
SINGLE_CORNER = 0.15
"""The same for one corner with 4000 trials, where noise is still small against the geometry."""

POSE = Rigid3(exp_so3(np.array([0.1, -0.3, 0.15])), [-260.0, 60.0, 90.0])
SIDEWAYS = Rigid3(np.eye(3), [-250.0, 40.0, 30.0])


@pytest.fixture(scope="module")
def scene() -> Corners:
    return general_pairs(np.random.default_rng(11), 10, (40.0, 70.0))


@pytest.fixture(params=["pinhole", "fisheye beyond 90 degrees"])
def corners(request: pytest.FixtureRequest) -> Corners:
    if request.param == "pinhole":
        out = see(REGULAR, REGULAR, POSE, [Rigid3(exp_so3(np.array([0.5, -0.4, 0.3])), [-100.0, -140.0, 900.0])])
    else:
        far = Rigid3(exp_so3(np.array([0.0, np.radians(105.0), 0.0])), np.zeros(3))
        board = far @ Rigid3(exp_so3(np.array([-0.3, 0.4, 0.8])), [-100.0, -140.0, 900.0])
        out = see(FISHEYE, FISHEYE, SIDEWAYS, [board])
        assert out is not None
        assert (out.points[:, 2] < 0.0).sum() > 10
    assert out is not None
    return out


def test_exact_affinities_give_exact_normals(corners: Corners) -> None:
    normals, valid = normals_from_affines(corners.J1, corners.J2, corners.A21)
    assert valid.all()
    assert angles_deg(normals, corners.normals).max() < EXACT_DEG
    assert (np.sum(normals * corners.points, axis=1) < 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)


def test_directions_straight_to_normals_in_raw_fisheye(corners: Corners) -> None:
    """Directions, epipolar normals and normals all in raw pixels, no rectification anywhere."""
    for method in ("F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR"):
        found = affines_from_directions(corners.directions(), method, epipolar=corners.epipolar)
        normals, valid = normals_from_affines(corners.J1, corners.J2, found.A21)
        assert valid.mean() > 0.9
        assert angles_deg(normals, corners.normals)[valid].max() < 1e-6


def test_optimal_is_never_above_brute_force(corners: Corners, rng: np.random.Generator) -> None:
    noisy = corners.A21 + 0.1 * rng.normal(size=corners.A21.shape)
    normals, _ = normals_from_affines(corners.J1, corners.J2, noisy)

    def cost(n: np.ndarray) -> np.ndarray:
        return np.linalg.norm(affines_from_normals(corners.J1, corners.J2, n)[0] - noisy, axis=(1, 2))

    best = cost(normals)
    for size in (1e-4, 1e-2, 0.3, 3.0):
        for _ in range(15):
            other = unit(normals + size * rng.normal(size=normals.shape))
            assert (cost(other) >= best * (1.0 - 1e-12)).all()


def test_depends_on_the_affinity_only_along_the_epipolar_line(corners: Corners, rng: np.random.Generator) -> None:
    across = rng.normal(size=(len(corners), 2))
    moved = corners.A21 + 0.2 * unit(corners.n2)[:, :, None] * across[:, None, :]
    normals, _ = normals_from_affines(corners.J1, corners.J2, moved)
    assert angles_deg(normals, corners.normals).max() < 1e-9


def test_invariant_to_the_pixels_of_image_1(corners: Corners, rng: np.random.Generator) -> None:
    noisy = corners.A21 + 0.1 * rng.normal(size=corners.A21.shape)
    L = np.eye(2) + 0.3 * rng.normal(size=(2, 2))
    if np.linalg.det(L) < 0.0:
        L = L[::-1]
    before, _ = normals_from_affines(corners.J1, corners.J2, noisy)
    after, _ = normals_from_affines(L @ corners.J1, corners.J2, noisy @ np.linalg.inv(L))
    assert angles_deg(before, after).max() < 1e-9


def test_undefined_at_the_epipole_and_without_affinity(corners: Corners) -> None:
    J2, A21 = corners.J2.copy(), corners.A21.copy()
    J2[3] = corners.J1[3]  # no parallax
    A21[4] = np.nan
    normals, valid = normals_from_affines(corners.J1, J2, A21)
    assert not valid[3]
    assert not valid[4]
    assert np.isnan(normals[4]).all()
    assert valid.sum() >= len(corners) - 2


class TestPredictedSigma:
    TRIALS = 300

    def rms(
        self, scene: Corners, method: str, sigma_deg: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Measured and predicted rms angle of every fifth corner, radians."""
        c = scene.select(np.arange(0, len(scene), 5))
        noise = DirectionNoise.angular(c.directions(), np.radians(sigma_deg), np.radians(sigma_deg))
        exact = affines_from_directions(c.directions(), method, epipolar=c.epipolar, noise=noise)
        predicted = estimate_normals(c.J1, c.J2, exact.A21, covariance=exact.covariance).sigma_rad
        big = c.select(np.repeat(np.arange(len(c)), self.TRIALS))
        found = affines_from_directions(turned(big.directions(), sigma_deg, rng), method, epipolar=big.epipolar)
        normals, _ = normals_from_affines(big.J1, big.J2, found.A21)
        square = np.radians(angles_deg(normals, big.normals)).reshape(len(c), self.TRIALS) ** 2
        return np.sqrt(np.nanmean(square, axis=1)), predicted

    @pytest.mark.parametrize("method", ["F3UDIR", "DET3UDIR", "2SDIR", "3SDIR"])
    def test_agrees_with_monte_carlo(self, method: str, scene: Corners, rng: np.random.Generator) -> None:
        measured, predicted = self.rms(scene, method, 0.3, rng)
        ratio = (measured / predicted)[np.isfinite(predicted)]
        assert len(ratio) > 200
        assert abs(np.median(ratio) - 1.0) < PREDICTED
        assert np.quantile(ratio, 0.1) > 0.85
        assert np.quantile(ratio, 0.9) < 1.15

    def test_two_directions_agree_in_the_median(self, scene: Corners, rng: np.random.Generator) -> None:
        """F2UDIR has heavy tails where a direction is nearly along its epipolar line: the median corner agrees."""
        measured, predicted = self.rms(scene, "F2UDIR", 0.3, rng)
        ratio = (measured / predicted)[np.isfinite(predicted)]
        assert abs(np.median(ratio) - 1.0) < PREDICTED

    def test_closed_form_of_isotropic_affinity_noise(self, scene: Corners, rng: np.random.Generator) -> None:
        """rms = sigma_A / |h| sqrt(tr(P M M^T P^T))."""
        c = scene
        x = c.points[:, :2] / c.points[:, 2:]
        M = np.zeros((len(c), 3, 2))
        f = REGULAR.focal_px
        M[:, 0, 0] = M[:, 1, 1] = f / c.points[:, 2]
        M[:, 2] = -f * x / c.points[:, 2:]
        d = unit(c.points)
        h = np.einsum("nij,nj->ni", c.J2, d)
        gauge = 1.0 / np.abs(np.sum(c.normals * d, axis=1))
        P = (np.eye(3) - c.normals[:, :, None] * c.normals[:, None, :]) / gauge[:, None, None]
        PM = P @ M
        expected = 0.01 / np.linalg.norm(h, axis=1) * np.sqrt(np.einsum("nij,nij->n", PM, PM))
        predicted = estimate_normals(c.J1, c.J2, c.A21, covariance=np.tile(1e-4 * np.eye(4), (len(c), 1, 1)))
        np.testing.assert_allclose(predicted.sigma_rad, expected, rtol=1e-2)
        normals, _ = normals_from_affines(c.J1, c.J2, c.A21 + 0.001 * rng.normal(size=c.A21.shape))
        ratio = np.radians(angles_deg(normals, c.normals)) / (0.1 * expected)
        assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=PREDICTED)

    def test_one_corner(self, scene: Corners, rng: np.random.Generator) -> None:
        c = scene.select(np.array([101]))
        noise = DirectionNoise.isotropic(c.directions(), 0.05, 0.08)
        exact = affines_from_directions(c.directions(), "3SDIR", noise=noise)
        predicted = estimate_normals(c.J1, c.J2, exact.A21, covariance=exact.covariance)
        many = c.select(np.zeros(4000, dtype=int))
        images = [e + s * rng.normal(size=e.shape) for e, s in ((many.exact1, 0.05), (many.exact2, 0.08))]
        found = affines_from_directions(
            DirectionPairs(image1=images[0], image2=images[1], valid=np.ones((4000, 3), dtype=bool)), "3SDIR"
        )
        normals, _ = normals_from_affines(many.J1, many.J2, found.A21)
        measured = np.sqrt(np.trace(np.cov(normals.T)))
        assert predicted.sigma_rad[0] == pytest.approx(measured, rel=SINGLE_CORNER)

    def test_every_corner_has_its_own(self, scene: Corners) -> None:
        """Twice the noise at one corner is twice the sigma there and nowhere else."""
        sigma = np.full((len(scene), 3), 0.1)
        first = self.sigma_of(scene, sigma)
        sigma[7] *= 2.0
        second = self.sigma_of(scene, sigma)
        assert second[7] == pytest.approx(2.0 * first[7], rel=1e-3)
        np.testing.assert_array_equal(np.delete(second, 7), np.delete(first, 7))

    @staticmethod
    def sigma_of(c: Corners, sigma_px: np.ndarray) -> np.ndarray:
        noise = DirectionNoise.isotropic(c.directions(), sigma_px, sigma_px)
        found = affines_from_directions(c.directions(), "3SDIR", noise=noise)
        return estimate_normals(c.J1, c.J2, found.A21, covariance=found.covariance).sigma_rad

    def test_stays_honest_where_the_normal_is_lost(self, rng: np.random.Generator) -> None:
        """A board in front and a forward motion: errors of 60 degrees and more must be announced at every corner."""
        boards = special_boards(25.0)[:1]
        lost = see(REGULAR, REGULAR, Rigid3(np.eye(3), [0.0, 0.0, -300.0]), boards)
        assert lost is not None
        directions = turned(lost.directions(), 3.0, rng)
        noise = DirectionNoise.angular(directions, np.radians(3.0), np.radians(3.0))
        found = affines_from_directions(directions, "3SDIR", noise=noise)
        estimate = estimate_normals(lost.J1, lost.J2, found.A21, covariance=found.covariance)
        error = np.radians(angles_deg(estimate.normals, lost.normals))
        assert np.median(error) > 0.5
        assert (estimate.sigma_rad < np.pi / 2.0).all()
        assert 0.7 < np.sqrt(np.mean(error**2) / np.mean(estimate.sigma_rad**2)) < 1.4

    def test_unknown_without_noise(self, scene: Corners) -> None:
        estimate = estimate_normals(scene.J1, scene.J2, scene.A21)
        assert estimate.valid.all()
        assert np.isnan(estimate.sigma_rad).all()


@pytest.mark.parametrize("wrong", [np.ones((4, 3, 2)), np.ones((3, 2, 3)), np.ones((2, 3)), 1.0, [["a"]]])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_arrays_of_other_shapes_are_refused(wrong: object, which: int) -> None:
    arrays: list[object] = [np.ones((4, 2, 3)), np.ones((4, 2, 3)), np.ones((4, 2, 2))]
    arrays[which] = wrong
    with pytest.raises(InputError, match=r"J1|J2|A21"):
        normals_from_affines(*arrays)  # type: ignore[arg-type]
