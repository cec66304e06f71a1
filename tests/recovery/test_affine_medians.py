"""Median normal errors of the estimators under the paper's direction noise and under corner noise.

The scenes and their medians were first computed by independent code; where the generator is fully specified (special
poses) the medians must agree within their statistical spread, elsewhere the order of the estimators must.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import GRID, REGULAR, SQUARE_MM, Corners, angles_deg, general_pairs, special_pairs, turned

from rigkit.affine.affinities import DirectionNoise
from rigkit.affine.directions import direction_field
from rigkit.affine.normal import estimate_normals, normals_from_affines
from rigkit.affine.registry import AFFINE_METHODS, affines_from_directions
from rigkit.core.detections import BoardDetection
from rigkit.core.matches import DirectionPairs

STAT_REL = 0.15
"""60 reseeded runs lie within 12 % of the figures for fixed poses (sd 2 %), within 22 % for random planar poses."""


def median_error(c: Corners, directions: DirectionPairs, method: str, scale: str = "area") -> float:
    """Median over all corners, with the paper's formula everywhere: no limit on the conditioning."""
    found = affines_from_directions(directions, method, epipolar=c.epipolar, scale=scale, min_conditioning=0.0)
    normals, valid = normals_from_affines(c.J1, c.J2, found.A21)
    return float(np.median(angles_deg(normals, c.normals)[valid]))


@pytest.fixture(scope="module")
def scene() -> Corners:
    return general_pairs(np.random.default_rng(12), 30, (40.0, 70.0))


class TestGeneralPose:
    def test_order_at_three_degrees(self, scene: Corners, rng: np.random.Generator) -> None:
        """2SDIR and 3SDIR best, F3UDIR better than F2UDIR; chord lengths as in the paper."""
        noisy = turned(scene.directions(chords=True), 3.0, rng)
        error = {method: median_error(scene, noisy, method) for method in AFFINE_METHODS}
        assert error["3SDIR"] < error["2SDIR"] < error["DET3UDIR"] < error["F3UDIR"] < error["F2UDIR"]
        assert error["F2UDIR"] == pytest.approx(7.5, abs=1.7)
        assert error["F3UDIR"] == pytest.approx(4.96, abs=1.0)
        assert error["2SDIR"] == pytest.approx(3.04, abs=0.6)
        assert error["3SDIR"] == pytest.approx(2.67, abs=0.5)

    def test_the_papers_determinant_is_worst_at_small_noise(self, scene: Corners, rng: np.random.Generator) -> None:
        noisy = turned(scene.directions(chords=True), 0.5, rng)
        error = {method: median_error(scene, noisy, method) for method in AFFINE_METHODS if method != "DET3UDIR"}
        biased = median_error(scene, noisy, "DET3UDIR", "sqmean")
        assert biased > max(error.values())
        assert median_error(scene, noisy, "DET3UDIR", "area") < 0.5 * biased

    @pytest.mark.parametrize("method", ["F2UDIR", "F3UDIR", "2SDIR", "3SDIR"])
    def test_error_grows_linearly(self, method: str, scene: Corners, rng: np.random.Generator) -> None:
        errors = [median_error(scene, turned(scene.directions(), s, rng), method) for s in (0.2, 0.4, 0.8, 1.6)]
        ratios = np.array(errors) / np.array([0.2, 0.4, 0.8, 1.6])
        assert ratios.max() / ratios.min() < 1.1

    def test_noise_in_one_image_is_less(self, scene: Corners, rng: np.random.Generator) -> None:
        both = median_error(scene, turned(scene.directions(), 3.0, rng), "F2UDIR")
        one = median_error(scene, turned(scene.directions(), 3.0, rng, "2"), "F2UDIR")
        assert both / one == pytest.approx(np.sqrt(2.0), rel=0.15)

    def test_small_parallax_is_worse(self, scene: Corners, rng: np.random.Generator) -> None:
        narrow = general_pairs(np.random.default_rng(13), 20, (8.0, 15.0))
        error = median_error(narrow, turned(narrow.directions(), 3.0, rng), "F2UDIR")
        assert error > 2.0 * median_error(scene, turned(scene.directions(), 3.0, rng), "F2UDIR")


SPECIAL = {"standard": (30.8, 20.4, 3.3), "forward": (80.2, 10.7, 11.8), "planar": (42.5, 16.9, 8.8)}
"""F2UDIR, boards turned by 25 degrees, 3 degrees of noise: planes in front, floor, right wall."""


class TestSpecialPoses:
    """F2UDIR at 3 degrees, true pose, baseline 300 mm; three planes: in front, floor, right wall."""

    def medians(self, pose: str, turn_deg: float, method: str, rng: np.random.Generator) -> np.ndarray:
        c = special_pairs(rng, 60, pose, turn_deg)
        noisy = turned(c.directions(), 3.0, rng)
        return np.array([self.on_plane(c, noisy, method, plane) for plane in range(3)])

    @staticmethod
    def on_plane(c: Corners, noisy: DirectionPairs, method: str, plane: int) -> float:
        on = c.plane == plane
        some = DirectionPairs(image1=noisy.image1[on], image2=noisy.image2[on], valid=noisy.valid[on])
        return median_error(c.select(on), some, method)

    @pytest.mark.parametrize("pose", ["standard", "forward", "planar"])
    def test_medians_and_worst_plane(self, pose: str, rng: np.random.Generator) -> None:
        found = self.medians(pose, 25.0, "F2UDIR", rng)
        # Planar poses are drawn at random: 60 of them spread twice as far.
        rel = STAT_REL if pose != "planar" else 2.0 * STAT_REL
        np.testing.assert_allclose(found, SPECIAL[pose], rtol=rel)
        assert found.argmax() == 0

    def test_forward_is_worst_with_2sdir(self, rng: np.random.Generator) -> None:
        standard, forward = (self.medians(pose, 25.0, "2SDIR", rng) for pose in ("standard", "forward"))
        np.testing.assert_allclose(standard, (12.9, 2.7, 3.2), rtol=STAT_REL)
        np.testing.assert_allclose(forward, (62.5, 9.0, 9.3), rtol=STAT_REL)

    def test_boards_along_the_axes_are_singular_in_standard_stereo(self, rng: np.random.Generator) -> None:
        found = self.medians("standard", 0.0, "F2UDIR", rng)
        np.testing.assert_allclose(found, (79.0, 53.0, 4.5), rtol=STAT_REL)


SIGMA_PX = 0.1


@pytest.fixture(scope="module")
def errors() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(14)
    scene = general_pairs(rng, 25, (15.0, 40.0))
    grid = np.rint(GRID / SQUARE_MM).astype(int)
    out: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for board in range(len(scene) // len(grid)):
        c = scene.select(np.arange(len(grid)) + board * len(grid))
        fields = []
        for exact in (c.pixels1, c.pixels2):
            noisy = exact + SIGMA_PX * rng.normal(size=exact.shape)
            detection = BoardDetection("b", 6, 8, grid, noisy, np.full(len(grid), SIGMA_PX))
            fields.append(direction_field(detection, REGULAR, support="neighbours"))
        directions = DirectionPairs(
            image1=fields[0].vectors, image2=fields[1].vectors, valid=fields[0].valid & fields[1].valid
        )
        noise = DirectionNoise.of_board(fields[0].covariance, fields[1].covariance)
        for method in AFFINE_METHODS:
            found = affines_from_directions(directions, method, epipolar=c.epipolar, noise=noise)
            e = estimate_normals(c.J1, c.J2, found.A21, covariance=found.covariance)
            row = (angles_deg(e.normals, c.normals)[e.valid], np.degrees(e.sigma_rad)[e.valid])
            out.setdefault(method, []).append(row)
    return {key: tuple(np.concatenate(v) for v in zip(*rows, strict=True)) for key, rows in out.items()}  # type: ignore[misc]


class TestCornerNoise:
    """0.1 px at every corner, directions with exact lengths from the same corners, predicted errors with it."""

    @pytest.mark.parametrize(
        ("method", "limit_deg"), [("2SDIR", 0.40), ("3SDIR", 0.40), ("DET3UDIR", 0.40), ("F3UDIR", 0.50)]
    )
    def test_medians(self, method: str, limit_deg: float, errors: dict) -> None:
        assert np.median(errors[method][0]) < limit_deg

    @pytest.mark.parametrize("method", AFFINE_METHODS)
    def test_predicted_errors(self, method: str, errors: dict) -> None:
        error, sigma = errors[method]
        assert np.sqrt(np.mean((error / sigma) ** 2)) == pytest.approx(1.0, abs=0.15)

    def test_diagonal_that_is_a_sum_adds_nothing(self, errors: dict) -> None:
        """With exact lengths 2SDIR, 3SDIR and DET3UDIR coincide."""
        np.testing.assert_allclose(errors["3SDIR"][0], errors["2SDIR"][0], atol=1e-6)
        np.testing.assert_allclose(errors["DET3UDIR"][0], errors["2SDIR"][0], atol=1e-6)
