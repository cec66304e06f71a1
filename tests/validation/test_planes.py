"""Planes against exact planes and Open3D's PCA, and the predicted tilt against the observed one."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.reconstructions import BOARDS, make_reconstruction, trihedral_poses

from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rotation import angle_between, exp_so3
from rigkit.interop.open3d import mean_and_covariance, plane_inliers, to_open3d
from rigkit.validation.boards import fit_lattice, measure_board, places_on
from rigkit.validation.planes import face_angle, fit_moved, fit_plane, normal_errors

EXACT_RAD = 1e-9
"""PCA of exact points at 1.5 m: rounding only."""
SIGMA_RATIO = (0.93, 1.07)
"""Observed over predicted spread of 1000 draws: its own standard deviation is 1 / sqrt(2000) = 2.2 %."""


def board_points(angle: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    rotation = exp_so3(np.array([angle, 0.5, -0.2]))
    points = BOARDS[0].points() @ rotation.T + np.array([-100.0, 40.0, 1200.0])
    return points, -rotation[:, 2]


def test_plane_of_exact_points_is_the_board_and_faces_the_camera() -> None:
    points, normal = board_points()
    plane = fit_plane(points)
    assert angle_between(plane.normal, normal) < EXACT_RAD
    assert plane.offset_mm == pytest.approx(float(normal @ points[0]), abs=1e-6)
    assert plane.offset_mm < 0.0
    assert plane.count == 48
    assert plane.rms_mm < 1e-9


def test_distances_are_positive_on_the_camera_s_side() -> None:
    points, _ = board_points()
    plane = fit_plane(points)
    moved = points + 2.0 * plane.normal
    assert plane.distances(moved) == pytest.approx(2.0)
    assert float(plane.distances(np.zeros(3))) > 0.0


def test_equal_weights_are_the_pca_of_open3d(rng: np.random.Generator) -> None:
    points, _ = board_points()
    points = points + rng.normal(size=points.shape) * 0.5
    _, scatter = mean_and_covariance(points)
    smallest = np.linalg.eigh(scatter)[1][:, 0]
    for covariance in (None, np.tile(0.04 * np.eye(3), (48, 1, 1))):
        plane = fit_plane(points, covariance)
        assert abs(plane.normal @ smallest) == pytest.approx(1.0, abs=1e-14)


def test_uncertain_points_pull_less(rng: np.random.Generator) -> None:
    points, normal = board_points()
    sigma = np.where(np.arange(48) % 2 == 0, 0.05, 2.0)
    noisy = points + rng.normal(size=(300, 48, 1)) * (sigma[:, None] * normal)
    covariance = sigma[:, None, None] ** 2 * np.eye(3)
    tilt = {
        name: np.sqrt(np.mean([angle_between(fit_plane(p, c).normal, normal) ** 2 for p in noisy]))
        for name, c in (("equal", None), ("weighted", covariance))
    }
    assert tilt["weighted"] < 0.2 * tilt["equal"]


@pytest.mark.parametrize("weighted", [False, True])
def test_predicted_tilt_is_the_observed_one(rng: np.random.Generator, weighted: bool) -> None:
    points, normal = board_points()
    sigma = np.linspace(0.1, 0.5, 48) if weighted else np.full(48, 0.3)
    covariance = sigma[:, None, None] ** 2 * np.eye(3) if weighted else None
    planes = [fit_plane(points + rng.normal(size=(48, 1)) * sigma[:, None] * normal, covariance) for _ in range(1000)]
    observed = np.sqrt(np.mean([angle_between(p.normal, normal) ** 2 for p in planes]))
    predicted = np.sqrt(np.mean([p.sigma_rad**2 for p in planes]))
    assert SIGMA_RATIO[0] < observed / predicted < SIGMA_RATIO[1]


@pytest.mark.parametrize("angles", [(90.0, 90.0, 90.0), (91.6, 90.0, 88.0)])
def test_face_angle_is_what_a_protractor_shows(angles: tuple[float, ...]) -> None:
    planes = [
        fit_plane(pose.apply(b.points())) for b, pose in zip(BOARDS, trihedral_poses(BOARDS, angles), strict=True)
    ]
    found = [face_angle(planes[i].normal, planes[j].normal) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert np.rad2deg(found) == pytest.approx(angles, abs=1e-9)


def test_a_corner_that_opens_wider_than_a_right_angle_is_more_than_90_degrees() -> None:
    # Two walls that meet far away, each `half` from the line of sight: from inside the room the opening is twice that.
    for half in (45.0, 50.0, 40.0):
        out = np.deg2rad(half)
        along = np.arange(3.0)[:, None] * 100.0 * np.array([-np.sin(out), 0.0, -np.cos(out)]) + [-50.0, 0.0, 2000.0]
        left = np.concatenate([along + np.array([0.0, y, 0.0]) for y in (0.0, 100.0, 200.0)])
        assert np.rad2deg(
            face_angle(fit_plane(left).normal, fit_plane(left * [-1.0, 1.0, 1.0]).normal)
        ) == pytest.approx(2.0 * half)


def test_normal_errors_are_angles_to_the_plane() -> None:
    reconstruction = make_reconstruction(normal_tilt_rad=np.deg2rad(2.0))
    on = reconstruction.cloud.on_board("plane2")
    errors = normal_errors(reconstruction.cloud.normals[on], fit_plane(reconstruction.cloud.points_mm[on]).normal)
    assert (errors.mean_deg, errors.median_deg, errors.max_deg) == pytest.approx((2.0, 2.0, 2.0), abs=1e-9)
    assert errors.count == 48


def test_quartiles_are_those_of_the_angles() -> None:
    tilts = np.deg2rad(np.arange(1.0, 6.0))
    plane = fit_plane(board_points()[0])
    across = np.cross(plane.normal, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    errors = normal_errors(np.cos(tilts)[:, None] * plane.normal + np.sin(tilts)[:, None] * across, plane.normal)
    assert (errors.lower_quartile_deg, errors.median_deg, errors.upper_quartile_deg) == pytest.approx((2.0, 3.0, 4.0))


def test_too_few_or_collinear_points_do_not_make_a_plane() -> None:
    points, _ = board_points()
    with pytest.raises(DegenerateError, match="3 points"):
        fit_plane(points[:3])
    with pytest.raises(DegenerateError, match="line"):
        fit_plane(points[:8])
    with pytest.raises(DegenerateError, match="no normals"):
        normal_errors(np.zeros((0, 3)), fit_plane(points).normal)
    with pytest.raises(InputError, match="covariance"):
        fit_plane(points, np.zeros((48, 3, 3)))


def test_lattice_finds_square_sizes_order_and_handedness() -> None:
    points, normal = board_points()
    true = Board("b", 8, 6, 50.0, 50.0)
    result = measure_board(Board("b", 8, 6, 48.0, 50.0), points, np.tile(normal, (48, 1)), true.grid())
    assert (result.square_x_ratio, result.square_y_ratio) == pytest.approx((50.0 / 48.0, 1.0), abs=1e-12)
    assert result.skew_deg < 1e-6
    assert result.right_handed
    mirrored = true.grid() * np.array([-1, 1]) + np.array([7, 0])
    assert not measure_board(true, points, np.tile(normal, (48, 1)), mirrored).right_handed


def test_lattice_places_a_corner_that_was_not_seen(rng: np.random.Generator) -> None:
    points, _ = board_points()
    seen = rng.permutation(48)[:30]
    place, _ = fit_lattice(points[seen], places_on(BOARDS[0], BOARDS[0].grid()[seen])).at(np.array([7.0, 5.0]))
    assert place == pytest.approx(points[47], abs=1e-9)


def test_ransac_finds_the_plane_that_most_points_share(rng: np.random.Generator) -> None:
    points, normal = board_points()
    spoiled = points.copy()
    spoiled[:12] += normal * rng.uniform(20.0, 200.0, (12, 1))
    mask = plane_inliers(spoiled, 1.0)
    assert not mask[:12].any()
    assert mask[12:].all()
    assert (mask == plane_inliers(spoiled, 1.0)).all()


def test_open3d_gets_the_cloud_unchanged() -> None:
    cloud = make_reconstruction().cloud
    out = to_open3d(cloud)
    assert (np.asarray(out.points) == cloud.points_mm).all()
    assert (np.asarray(out.normals) == cloud.normals).all()
    assert (np.rint(np.asarray(out.colors) * 255) == cloud.colours).all()


def test_corners_that_are_none_do_not_tilt_the_plane(rng: np.random.Generator) -> None:
    """Five of 48 corners, all on one side, are the edge of something 15 to 40 mm in front of the board."""
    points, normal = board_points()
    sigma = np.linspace(0.1, 0.4, 48)
    points = points + (rng.normal(size=48) * sigma)[:, None] * normal
    covariance = 25.0 * sigma[:, None, None] ** 2 * np.eye(3)
    clean = fit_plane(points, covariance)
    assert clean.used.all()
    bad = np.array([40, 41, 42, 46, 47])
    spoiled = points.copy()
    spoiled[bad] += np.linspace(15.0, 40.0, 5)[:, None] * normal
    plane = fit_plane(spoiled, covariance)
    assert (np.flatnonzero(~plane.used) == bad).all()
    assert plane.count == 43
    # What the others alone give, nothing else.
    rest = np.delete(np.arange(48), bad)
    alone = fit_plane(points[rest], covariance[rest])
    assert angle_between(plane.normal, alone.normal) < EXACT_RAD
    assert angle_between(fit_plane(spoiled).normal, normal) > 30.0 * angle_between(alone.normal, normal)
    result = measure_board(BOARDS[0], spoiled, np.tile(normal, (48, 1)), BOARDS[0].grid(), covariance)
    assert result.square_x_ratio == pytest.approx(1.0, abs=1e-3)
    assert result.lattice.at(np.array([7.0, 5.0]))[0] @ normal == pytest.approx(points[47] @ normal, abs=1.0)


def test_ordinary_scatter_loses_no_corner(rng: np.random.Generator) -> None:
    points, normal = board_points()
    sigma = np.linspace(0.1, 1.0, 48)
    covariance = sigma[:, None, None] ** 2 * np.eye(3)
    for scatter in (0.0, 1.0):
        for _ in range(200):
            noisy = points + (scatter * rng.normal(size=48) * sigma)[:, None] * normal
            assert fit_plane(noisy, covariance).used.all()


def bend(count: int, strength: float) -> np.ndarray:
    """How shared errors move the board's points across it (count, 48), mm: a twist, and one that grows to a side."""
    x, y = (BOARDS[0].grid() / np.array([7.0, 5.0]) * 2.0 - 1.0).T
    return strength * np.stack([x * y, np.exp(4.0 * (x - 1.0)) * 10.0])[:count]


def test_what_shared_errors_bend_is_neither_noise_nor_gross(rng: np.random.Generator) -> None:
    """Errors of pose and calibration fifty times the noise: no corner is lost, and the noise is told from them."""
    points, normal = board_points()
    moves = bend(2, 1.0)
    common = moves[:, :, None] * normal
    covariance = np.tile(np.eye(3), (48, 1, 1))
    noise = []
    for _ in range(300):
        shared = rng.normal(size=2) @ moves
        plane = fit_plane(points + (shared + 0.2 * rng.normal(size=48))[:, None] * normal, covariance, common)
        assert plane.gross == 0
        noise.append(plane.noise_mm2.mean())
    # 43 degrees of freedom in 300 draws: 1.2 %.
    assert np.mean(noise) == pytest.approx(0.2**2, rel=0.04)


def test_a_gross_outlier_is_one_beside_shared_errors(rng: np.random.Generator) -> None:
    points, normal = board_points()
    moves = bend(1, 0.5)
    spoiled = points + (rng.normal(size=1) @ moves + 0.1 * rng.normal(size=48))[:, None] * normal
    spoiled[[16, 17]] += 25.0 * normal
    plane = fit_plane(spoiled, np.tile(np.eye(3), (48, 1, 1)), moves[:, :, None] * normal)
    assert plane.gross == 2
    assert (np.flatnonzero(~plane.used) == [16, 17]).all()


def test_points_that_shared_errors_move_far_pull_less(rng: np.random.Generator) -> None:
    """Beside an epipole some corners are off by millimetres, all of a board in the same way."""
    points, normal = board_points()
    moves = bend(2, 0.5)
    common, covariance = moves[:, :, None] * normal, np.tile(np.eye(3), (48, 1, 1))
    tilts: dict[str, list[np.ndarray]] = {"declared": [], "undeclared": []}
    for _ in range(200):
        off = points + (rng.normal(size=2) @ moves + 0.05 * rng.normal(size=48))[:, None] * normal
        tilts["declared"].append(angle_between(fit_plane(off, covariance, common).normal, normal))
        tilts["undeclared"].append(angle_between(fit_plane(off, covariance).normal, normal))
    declared, undeclared = (np.sqrt(np.mean(np.square(tilts[name]))) for name in ("declared", "undeclared"))
    assert declared < 0.4 * undeclared


def test_points_that_nobody_can_place_are_left_out_without_a_word(rng: np.random.Generator) -> None:
    points, normal = board_points()
    noisy = points + 0.1 * rng.normal(size=48)[:, None] * normal
    common = np.zeros((2, 48, 3))
    common[0, 47] = np.nan
    common[1, 40] = 30.0 * normal
    plane = fit_plane(noisy, np.tile(np.eye(3), (48, 1, 1)), common)
    assert (np.flatnonzero(~plane.used) == [40, 47]).all()
    assert plane.gross == 0


def test_moved_points_are_fitted_with_the_same_weights(rng: np.random.Generator) -> None:
    """Moving the points by a plane tilts the plane by it, and gross outliers stay out."""
    points, normal = board_points()
    sigma = np.linspace(0.1, 0.4, 48)
    noisy = points + (rng.normal(size=48) * sigma)[:, None] * normal
    noisy[5] += 40.0 * normal
    plane = fit_plane(noisy, sigma[:, None, None] ** 2 * np.eye(3))
    slope = np.array([2e-5, -1e-5])
    heights = 0.3 + (noisy - plane.centroid_mm) @ plane.tangents @ slope
    assert not plane.used[5]
    ways = np.array([0.0, 1.0, -2.0])
    normal, offset_mm = fit_moved(noisy + ways[:, None, None] * heights[:, None] * plane.normal, plane)
    np.testing.assert_allclose(normal - plane.normal, -np.outer(ways, plane.tangents @ slope), atol=2e-9)
    np.testing.assert_allclose(offset_mm, plane.offset_mm + 0.3 * ways, atol=0.04)
    np.testing.assert_allclose(offset_mm[0], plane.offset_mm, rtol=1e-12)


def test_where_the_plane_passes_a_point_is_as_uncertain_as_observed(rng: np.random.Generator) -> None:
    points, normal = board_points()
    sigma = np.linspace(0.1, 0.5, 48)
    covariance = sigma[:, None, None] ** 2 * np.eye(3)
    place = points[40] + 30.0 * (points[47] - points[46]) / 50.0
    planes = [fit_plane(points + (rng.normal(size=48) * sigma)[:, None] * normal, covariance) for _ in range(1000)]
    observed = np.sqrt(np.mean([p.distances(place) ** 2 for p in planes]))
    predicted = np.sqrt(np.mean([p.variance_at(place) for p in planes]))
    assert SIGMA_RATIO[0] < observed / predicted < SIGMA_RATIO[1]
