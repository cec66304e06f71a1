"""Contaminated matches: found again, deterministic, honest about which matches fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.epipolar_scenes import REGULAR, joined, pair, pictures, plane_in_sight, pose_errors_deg

from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.geometry.sampson import sampson_distances
from rigkit.relative_pose.refinement.local import SampsonRows, marginal_quality, marginal_weights
from rigkit.relative_pose.refinement.refine import refine_pose
from rigkit.relative_pose.robust import BATCH, _draw, robust_pose
from rigkit.relative_pose.solvers.planar_ambiguity import other_ambiguous_poses
from rigkit.relative_pose.solvers.pose import essential_from_pose


def contaminated(rng, kind, count=120, outliers=0.4, noise_px=0.5, sigma_A=0.03):
    m, pose, _ = pair(rng, count, kind, noise_px=noise_px, sigma_A=sigma_A)
    bad = np.arange(count) < int(outliers * count)
    q2, A = np.array(m.pixels2), np.array(m.A21)
    q2[bad] = rng.uniform([0, 0], [1624, 1240], (bad.sum(), 2))
    A[bad] = rng.normal(size=(bad.sum(), 2, 2))
    wild = Matches.from_cameras(
        REGULAR, REGULAR, m.pixels1, q2, sigma1_px=m.sigma1_px, sigma2_px=m.sigma2_px, A21=A, sigma_A=m.sigma_A
    )
    return wild, pose, bad


@pytest.mark.parametrize("kind", ["general", "planar", "standard"])
@pytest.mark.parametrize("sample", ["points", "affine"])
def test_outliers_do_not_matter(rng, kind, sample):
    wild, pose, bad = contaminated(rng, kind)
    found = robust_pose(wild, rng, pose_type=kind, sample=sample)
    clean = refine_pose(wild.select(~bad), pose, kind)
    errors, best = pose_errors_deg(found.refined.cam2_from_cam1, pose), pose_errors_deg(clean.cam2_from_cam1, pose)
    # Half a degree is five times what the clean matches give here, and a hundredth of what the wild ones do.
    assert max(errors) < max(best) + 0.5
    assert found.inliers[~bad].mean() > 0.97
    # A wrong partner lies near its epipolar line by chance: 15 px of 1240.
    assert found.inliers[bad].mean() < 0.15


def test_samples_are_drawn_until_one_without_outliers_is_likely(rng):
    """Of five points each, one sample in a thousand has none: one batch finds such a pose in half of the scenes."""
    for _ in range(4):
        wild, pose, _ = contaminated(rng, "general", count=150, outliers=0.75)
        assert max(pose_errors_deg(robust_pose(wild, rng).refined.cam2_from_cam1, pose)) < 2.0


def test_samples_have_no_match_twice_and_all_alike(rng):
    among = np.array([3, 5, 8, 9, 14])
    drawn = np.concatenate([_draw(rng, among, 3) for _ in range(50)])
    assert all(len(set(sample)) == 3 for sample in drawn.tolist())
    counts = (drawn[..., None] == among).sum(axis=0)
    # Five standard deviations of a share of a fifth.
    assert np.abs(counts - len(drawn) / 5.0).max() < 5.0 * np.sqrt(50 * BATCH * 0.2 * 0.8)


def test_the_same_seed_gives_the_same_answer(rng):
    wild, _, _ = contaminated(rng, "general")
    a, b = (robust_pose(wild, np.random.default_rng(5)).refined.cam2_from_cam1.matrix() for _ in range(2))
    assert np.array_equal(a, b)


def test_quality_and_weights_belong_together():
    r = np.linspace(0.01, 30.0, 4000)
    q, w = marginal_quality(r, 6.0), marginal_weights(r, 6.0)
    assert marginal_quality(np.zeros(1), 6.0)[0] == pytest.approx(1.0)
    assert (np.diff(q) <= 0).all()
    assert (q[r > 6.0 * 2.577] == 0).all()
    # w is -q'(r) / r up to one factor.
    slope = -np.gradient(q, r) / r
    inside = (w > 1e-3)[1:-1]
    ratio = (slope[1:-1] / np.maximum(w[1:-1], 1e-12))[inside]
    assert ratio.std() / ratio.mean() < 1e-2


def test_what_is_missing_is_said(rng):
    wild, _, _ = contaminated(rng, "general", count=20)
    with pytest.raises(InputError, match="need 2 affinities"):
        robust_pose(replace(wild, A21=None, sigma_A=None), rng, sample="affine")
    with pytest.raises(InputError, match="at least 6"):
        robust_pose(wild.select(np.arange(5)), rng)
    with pytest.raises(InputError, match="no samples"):
        robust_pose(wild, rng, sample="lines")  # type: ignore[arg-type]


@pytest.mark.parametrize("max_noise", [1.0, np.nan])
def test_a_noise_level_without_a_meaning_is_refused(rng, max_noise):
    wild, _, _ = contaminated(rng, "general", count=20)
    with pytest.raises(InputError, match="max_noise"):
        robust_pose(wild, rng, max_noise=max_noise)


def test_a_pose_without_samples_counts_none(rng: np.random.Generator) -> None:
    """Disparities of both signs alike: neither direction of standard stereo puts most points in front."""
    pixels = rng.uniform([200.0, 200.0], [1400.0, 1000.0], (20, 2))
    others = pixels + np.where(np.arange(20) % 2, 6.0, -6.0)[:, None] * [1.0, 0.0]
    with pytest.raises(DegenerateError, match="in front of both cameras; check"):
        robust_pose(Matches.from_cameras(REGULAR, REGULAR, pixels, others), rng, pose_type="standard")


def test_the_same_match_again_says_nothing_more(rng):
    m, _, _ = pair(rng, 5, noise_px=0.5)
    with pytest.raises(InputError, match="5 different matches"):
        robust_pose(m.select(np.repeat(np.arange(5), 20)), rng)


def with_wrong(rng, m, share=0.3):
    """The same matches with wrong partners for some of them."""
    bad, q2 = rng.random(len(m)) < share, np.array(m.pixels2)
    q2[bad] = rng.uniform([0, 0], REGULAR.size_px, (bad.sum(), 2))
    return Matches.from_cameras(REGULAR, REGULAR, m.pixels1, q2, sigma1_px=m.sigma1_px, sigma2_px=m.sigma2_px)


@pytest.mark.parametrize("share", [0.0, 0.3])
@pytest.mark.parametrize("kind", ["general", "planar", "standard"])
@pytest.mark.parametrize("understated", [1.0, 3.0])
def test_a_pose_without_a_baseline_is_refused(rng, kind, share, understated):
    X = rng.uniform([-500.0, -400.0, 800.0], [500.0, 400.0, 2000.0], (200, 3))
    turn = [0.0, 0.0 if kind == "standard" else 0.1, 0.0]
    m = pictures(rng, X, Rigid3(exp_so3(turn), np.zeros(3)))
    m = replace(m, sigma1_px=m.sigma1_px / understated, sigma2_px=m.sigma2_px / understated)
    with pytest.raises(DegenerateError, match="no baseline"):
        robust_pose(with_wrong(rng, m, share), rng, pose_type=kind)


def test_the_right_one_of_the_two_poses_of_a_plane_or_none(rng):
    solved = 0
    for _ in range(30):
        m, pose = plane_in_sight(rng)
        try:
            found = robust_pose(with_wrong(rng, m, 0.2), rng).refined.cam2_from_cam1
        except DegenerateError as error:
            assert "one plane" in str(error)
            continue
        assert max(pose_errors_deg(found, pose)) < 2.0
        solved += 1
    assert solved > 10


def test_points_off_the_plane_choose_between_its_poses(rng):
    for _ in range(10):
        m, pose = plane_in_sight(rng)
        others, _, _ = pair(rng, 60, pose=pose, noise_px=0.3)
        found = robust_pose(with_wrong(rng, joined(m, others)), rng).refined.cam2_from_cam1
        assert max(pose_errors_deg(found, pose)) < 2.0


def test_nothing_but_outliers_gives_few_inliers_or_an_error(rng):
    wild, _, bad = contaminated(rng, "general", outliers=1.0, count=60)
    assert bad.all()
    try:
        found = robust_pose(wild, rng)
    except DegenerateError:
        return
    assert found.inliers.mean() < 0.6


def test_all_hypotheses_at_once_are_as_one_by_one(rng):
    wild, pose, _ = contaminated(rng, "general")
    E21 = np.stack([essential_from_pose(pose), *rng.normal(size=(5, 3, 3))])
    expected = sampson_distances(
        E21, wild.rays1, wild.rays2, wild.jacobians1, wild.jacobians2, wild.sigma1_px, wild.sigma2_px
    )
    assert SampsonRows.of(wild).residuals(E21) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("kind", ["general", "planar"])
def test_the_batch_ends_near_the_maximum_likelihood_pose(rng, kind):
    clean, pose, _ = pair(rng, 100, kind, noise_px=0.1)
    clean = replace(clean, A21=None, sigma_A=None)
    best = refine_pose(clean, pose, kind)
    turns = np.zeros((8, 3))
    turns[:, 1] = rng.normal(0.0, np.radians(1.0), 8)
    starts = np.stack([essential_from_pose(Rigid3(exp_so3(w) @ pose.rotation, pose.translation_mm)) for w in turns])
    # With sigmas a few times too large all residuals lie where the loss is a parabola.
    wide = replace(clean, sigma1_px=3.0 * clean.sigma1_px, sigma2_px=3.0 * clean.sigma2_px)
    found = SampsonRows.of(wide).improved(starts, kind, 600.0, 60.0, 6.0)[-1]
    truth = essential_from_pose(best.cam2_from_cam1)
    sign = np.sign(np.sum(found * truth, axis=(1, 2), keepdims=True))
    # How the distances' own sigmas change with the pose is left out: that is second order in the noise.
    sigma = np.sqrt(np.diag(best.covariance).max())
    assert found * sign == pytest.approx(np.broadcast_to(truth, found.shape), abs=0.1 * sigma)


def test_a_plane_is_not_looked_for_where_no_match_fits(rng: np.random.Generator) -> None:
    m, pose, _ = pair(rng, 30, "general")
    none = np.zeros(30, bool)
    assert other_ambiguous_poses(m, none, 1.0, Rigid3(pose.rotation, pose.translation_mm / 300.0)) == ()
    none[:3] = True
    assert other_ambiguous_poses(m, none, 1.0, Rigid3(pose.rotation, pose.translation_mm / 300.0)) == ()
