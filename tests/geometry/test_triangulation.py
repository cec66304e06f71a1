"""Triangulation against brute force, OpenCV, and Monte Carlo."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.hartley_sturm import correct_hartley_sturm

from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3, skew, unit
from rigkit.geometry.sampson import sampson_distances
from rigkit.geometry.triangulation import (
    correct_lindstrom,
    correct_rays,
    correct_rays_px,
    point_uncertainty,
    ray_ranges,
    triangulate_midpoint,
    triangulate_pixels,
    triangulate_rays,
)

K = np.array([[1350.0, 0.0, 800.0], [0.0, 1300.0, 620.0], [0.0, 0.0, 1.0]])
POSES = {
    "general": Rigid3(exp_so3(np.array([0.1, -0.3, 0.05])), [-300.0, 20.0, 50.0]),
    "standard": Rigid3(np.eye(3), [-300.0, 0.0, 0.0]),
    "forward": Rigid3(np.eye(3), [0.0, 0.0, -150.0]),
}
EXACT_MM = 1e-6
"""Exact pixels give exact points at 1 m: rounding of 1e-13 px times a range / focal of about 1, with margin."""
EPIPOLAR_PX = 1e-4
"""Lindstrom's two iterations leave at most 1e-5 px at 3 px of noise (published and measured), ten times that here."""
COST_REL = 1e-6
"""Two optimal methods: measured 1e-9 at 3 px; OpenCV's polynomial roots are good to 1e-4."""


def fundamental(pose: Rigid3) -> np.ndarray:
    inverse = np.linalg.inv(K)
    F = inverse.T @ skew(pose.translation_mm) @ pose.rotation @ inverse
    return F / np.linalg.norm(F)


def scene(rng, pose, count=60, noise_px=0.0):
    X = rng.uniform([-300, -200, 800], [300, 200, 1400], (count, 3))
    pixels = []
    for points in (X, pose.apply(X)):
        h = points @ K.T
        pixels.append(h[:, :2] / h[:, 2:] + rng.normal(size=(count, 2)) * noise_px)
    return X, pixels[0], pixels[1]


def rays_of(pixels):
    inverse = np.linalg.inv(K)
    g = pixels @ inverse[:, :2].T + inverse[:, 2]
    length = np.linalg.norm(g, axis=1)[:, None, None]
    f = unit(g)
    dg = np.broadcast_to(inverse[:, :2], (len(g), 3, 2))
    return f, (dg - f[:, :, None] * (f[:, None, :] @ dg)) / length


def epipolar_px(F, q1, q2):
    h1, h2 = (np.concatenate([q, np.ones((len(q), 1))], 1) for q in (q1, q2))
    n1, n2 = (h2 @ F)[:, :2], (h1 @ F.T)[:, :2]
    return np.sum(h2 * (h1 @ F.T), 1) / np.sqrt((n1**2).sum(1) + (n2**2).sum(1))


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
@pytest.mark.parametrize("noise_px", [0.0, 0.3, 3.0])
def test_pixel_corrections_agree_and_satisfy_the_geometry(rng, pose, noise_px):
    _, q1, q2 = scene(rng, pose, noise_px=noise_px)
    F = fundamental(pose)
    cost = {}
    for name, correct in (("lindstrom", correct_lindstrom), ("hartley_sturm", correct_hartley_sturm)):
        p1, p2 = correct(q1, q2, F)
        assert np.abs(epipolar_px(F, p1, p2)).max() < EPIPOLAR_PX, name
        cost[name] = np.sum((p1 - q1) ** 2, 1) + np.sum((p2 - q2) ** 2, 1)
    assert np.all(cost["hartley_sturm"] <= cost["lindstrom"] * (1 + COST_REL) + 1e-12)
    assert np.all(cost["lindstrom"] <= cost["hartley_sturm"] * (1 + COST_REL) + 1e-12)


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_correction_is_the_optimum_over_points(rng, pose):
    """Brute force: no 3D point near the optimum, found by a general minimiser, reprojects better."""
    from scipy.optimize import least_squares

    X, q1, q2 = scene(rng, pose, count=12, noise_px=2.0)
    p1, p2 = correct_hartley_sturm(q1, q2, fundamental(pose))
    ours = np.sum((p1 - q1) ** 2, 1) + np.sum((p2 - q2) ** 2, 1)

    def residual(point, a, b):
        out = []
        for x, q in ((point, a), (pose.apply(point), b)):
            h = K @ x
            out.append(h[:2] / h[2] - q)
        return np.concatenate(out)

    for start, a, b, cost in zip(X, q1, q2, ours, strict=True):
        best = least_squares(residual, start, args=(a, b), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert cost == pytest.approx(2.0 * best.cost, rel=1e-6)


def test_global_optimum_near_the_epipole_with_much_noise(rng):
    """Where the cost has several minima: every epipolar line of a fine pencil is tried."""
    pose = POSES["forward"]
    F = fundamental(pose)
    epipole = np.array([800.0, 620.0])
    q1, q2 = (epipole + rng.normal(size=(200, 2)) * 30.0 for _ in range(2))
    p1, p2 = correct_hartley_sturm(q1, q2, F)
    ours = np.sum((p1 - q1) ** 2, 1) + np.sum((p2 - q2) ** 2, 1)
    # Forward motion without rotation: the same line through the same epipole in both images.
    angle = np.linspace(0.0, np.pi, 20001)
    normal = np.stack([-np.sin(angle), np.cos(angle)])
    brute = (((q1 - epipole) @ normal) ** 2 + ((q2 - epipole) @ normal) ** 2).min(axis=1)
    assert np.all(ours <= brute * (1 + 1e-9) + 1e-9)
    assert np.allclose(ours, brute, rtol=1e-4, atol=1e-3)


def test_opencv_correct_matches_has_the_same_cost(rng):
    pose = POSES["general"]
    _, q1, q2 = scene(rng, pose, noise_px=3.0)
    F = fundamental(pose)
    p1, p2 = correct_hartley_sturm(q1, q2, F)
    c1, c2 = cv2.correctMatches(F, q1[None], q2[None])
    ours = np.sum((p1 - q1) ** 2, 1) + np.sum((p2 - q2) ** 2, 1)
    theirs = np.sum((c1[0] - q1) ** 2, 1) + np.sum((c2[0] - q2) ** 2, 1)
    assert np.all(ours <= theirs * (1 + COST_REL) + 1e-12)
    assert np.median(np.abs(theirs / ours - 1.0)) < 1e-4


def test_unequal_sigmas_move_the_worse_image(rng):
    """Sigmas only scale the pixels: with both images in units of theirs the correction is Lindstrom's."""
    pose = POSES["general"]
    _, q1, q2 = scene(rng, pose, noise_px=1.0)
    E = skew(pose.translation_mm) @ pose.rotation
    rays1, B1 = rays_of(q1)
    rays2, B2 = rays_of(q2)
    _, _, d1, d2 = correct_rays_px(rays1, rays2, E, B1, B2, sigma1_px=0.01, sigma2_px=1.0, iterations=4)
    in_sigmas = np.diag([0.01, 0.01, 1.0])
    p1, p2 = correct_lindstrom(q1 / 0.01, q2, fundamental(pose) @ in_sigmas)
    assert np.abs(0.01 * p1 - q1).max() < 1e-3
    # The two parametrise the displacement differently (ray tangent or pixel): equal to second order.
    assert np.abs(d2 - (p2 - q2)).max() < 1e-2
    assert np.abs(d1 - (0.01 * p1 - q1)).max() < 1e-4


def test_pair_on_both_epipoles_is_left_alone():
    pose = POSES["forward"]
    q = np.array([[800.0, 620.0]])
    for correct in (correct_lindstrom, correct_hartley_sturm):
        p1, p2 = correct(q, q, fundamental(pose))
        assert np.abs(p1 - q).max() < 1e-9
        assert np.abs(p2 - q).max() < 1e-9


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_exact_pixels_give_exact_points(rng, pose):
    X, q1, q2 = scene(rng, pose)
    rays1, B1 = rays_of(q1)
    rays2, B2 = rays_of(q2)
    found = [
        triangulate_pixels(q1, q2, K, K, pose),
        triangulate_rays(rays1, rays2, pose),
        triangulate_rays(rays1, rays2, pose, jacobians1=B1, jacobians2=B2),
        triangulate_midpoint(rays1, rays2, pose),
    ]
    for points, valid in found:
        assert valid.all()
        assert np.abs(points - X).max() < EXACT_MM


def test_angular_optimum_beyond_180_degrees(rng):
    """Points all around two cameras, also behind their image planes; no turn of the rays costs less."""
    pose = POSES["general"]
    X = unit(rng.normal(size=(200, 3))) * rng.uniform(500, 2000, (200, 1))
    X = X[angle_between(X, pose.inverse().translation_mm) > 0.1]
    rays1, rays2 = unit(X), unit(pose.apply(X))
    assert (rays1[:, 2] < 0).sum() > 30
    points, valid = triangulate_rays(rays1, rays2, pose)
    assert valid.all()
    assert np.abs(points - X).max() < 1e-4
    noisy1, noisy2 = (unit(r + rng.normal(size=r.shape) * 2e-3) for r in (rays1, rays2))
    near1, near2 = correct_rays(noisy1, noisy2, pose)
    E = skew(unit(pose.translation_mm)) @ pose.rotation
    assert np.abs(np.sum(near2 * (near1 @ E.T), 1)).max() < 1e-14
    cost = np.sin(angle_between(near1, noisy1)) ** 2 + np.sin(angle_between(near2, noisy2)) ** 2
    turn = np.linspace(-np.pi, np.pi, 20001)
    basis = np.linalg.svd(unit(pose.translation_mm)[None])[2][1:]
    normals = np.cos(turn)[:, None] * basis[0] + np.sin(turn)[:, None] * basis[1]
    all_costs = (noisy1 @ pose.rotation.T @ normals.T) ** 2 + (noisy2 @ normals.T) ** 2
    brute = all_costs.min(axis=1)
    assert np.all(cost <= brute * (1 + 1e-9) + 1e-18)


def test_cheirality_is_the_sign_of_the_range():
    pose = Rigid3(np.eye(3), [-100.0, 0.0, 0.0])
    diverging = unit(np.array([[-0.1, 0.0, 1.0]])), unit(np.array([[0.1, 0.0, 1.0]]))
    range1, range2, defined = ray_ranges(*diverging, pose)
    assert defined.all()
    assert range1[0] < 0
    assert range2[0] < 0
    assert not triangulate_rays(*diverging, pose)[1].any()
    parallel = np.array([[0.0, 0.0, 1.0]])
    points, valid = triangulate_rays(parallel, parallel, pose)
    assert not valid.any()
    assert not np.isfinite(points).any()


def test_sampson_distance_is_the_first_order_correction(rng):
    pose = POSES["general"]
    _, q1, q2 = scene(rng, pose, noise_px=0.05)
    F = fundamental(pose)
    p1, p2 = correct_hartley_sturm(q1, q2, F)
    true_px = np.sqrt(np.sum((p1 - q1) ** 2, 1) + np.sum((p2 - q2) ** 2, 1))
    rays1, B1 = rays_of(q1)
    rays2, B2 = rays_of(q2)
    E = skew(pose.translation_mm) @ pose.rotation
    sampson = sampson_distances(E, rays1, rays2, B1, B2)
    assert np.abs(np.abs(sampson) - true_px).max() < 1e-4
    many = sampson_distances(np.stack([E, -2.0 * E]), rays1, rays2, B1, B2)
    assert np.allclose(many, [sampson, -sampson])


def test_point_covariance_agrees_with_monte_carlo(rng):
    pose = POSES["general"]
    X, q1, q2 = scene(rng, pose, count=20)
    sigma1, sigma2, trials = 0.3, 0.6, 4000
    f1, B1 = rays_of(q1)
    f2, B2 = rays_of(q2)
    predicted, _ = point_uncertainty(X, pose, f1, f2, B1, B2, sigma1, sigma2)
    noisy1 = (q1 + rng.normal(size=(trials, *q1.shape)) * sigma1).reshape(-1, 2)
    noisy2 = (q2 + rng.normal(size=(trials, *q2.shape)) * sigma2).reshape(-1, 2)
    f1, B1 = rays_of(noisy1)
    f2, B2 = rays_of(noisy2)
    points, valid = triangulate_rays(f1, f2, pose, jacobians1=B1, jacobians2=B2, sigma1_px=sigma1, sigma2_px=sigma2)
    assert valid.all()
    error = points.reshape(trials, -1, 3) - X
    measured = np.einsum("tni,tnj->nij", error, error) / trials
    # 4000 trials: a variance is known to 2.2 %; 20 points x 3 axes stay within 5 of those.
    for axis in range(3):
        assert np.allclose(measured[:, axis, axis] / predicted[:, axis, axis], 1.0, atol=0.11)
    ratio = np.trace(measured @ np.linalg.inv(predicted), axis1=1, axis2=2) / 3.0
    assert abs(ratio.mean() - 1.0) < 0.03


def test_points_move_with_the_pose_as_their_derivatives_say(rng):
    pose = POSES["general"]
    _, q1, q2 = scene(rng, pose, count=20, noise_px=0.1)
    (f1, B1), (f2, B2) = rays_of(q1), rays_of(q2)
    sigmas = {"sigma1_px": 0.3, "sigma2_px": 0.6}

    def points(step):
        return triangulate_rays(f1, f2, pose.moved(step), jacobians1=B1, jacobians2=B2, **sigmas)[0]

    _, by_pose = point_uncertainty(points(np.zeros(6)), pose, f1, f2, B1, B2, **sigmas)
    steps = np.diag(np.repeat([1e-6, 1e-3], 3))
    moved = np.stack([(points(s) - points(-s)) / (2.0 * s.sum()) for s in steps], axis=-1)
    # Residuals of 0.1 px at 1350 px per radian bend the derivative by as much: measured 1.4e-3 of its size.
    assert np.abs(by_pose - moved).max() < 5e-3 * np.abs(moved).max()


@pytest.mark.filterwarnings("error")
def test_cameras_in_one_place_triangulate_nothing(rng):
    still = Rigid3(exp_so3(np.array([0.0, 0.1, 0.0])), np.zeros(3))
    X = rng.uniform([-300, -200, 700], [300, 200, 1500], (20, 3))
    rays1, rays2 = unit(X), unit(still.apply(X))
    assert not triangulate_rays(rays1, rays2, still)[1].any()
    q1, q2 = (((f / f[:, 2:]) @ K.T)[:, :2] for f in (rays1, rays2))
    assert not triangulate_pixels(q1, q2, K, K, still)[1].any()
