"""What every epipolar solver must do, over the registry."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.epipolar_scenes import (
    FISHEYE,
    REGULAR,
    pixel_fundamental,
    plane_in_sight,
    pose_errors_deg,
    same_up_to_sign,
)
from helpers.epipolar_scenes import pair as pair_of_type
from helpers.tolerances import EXACT_REL

from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew, unit
from rigkit.relative_pose.solvers.pose import choose_pose, essential_from_pose, hypothesis_poses
from rigkit.relative_pose.solvers.registry import SOLVERS, fundamental_for

CAMERAS = {"pinhole": REGULAR, "fisheye": FISHEYE}
KINDS = sorted(SOLVERS)
SAMPLE = {
    "general": 12,
    "planar": 8,
    "translation": 6,
    "standard": 5,
    "forward": 5,
    "standard-rows": 5,
    "forward-roll": 5,
}
SCENE = {"standard-rows": "standard", "forward-roll": "forward"}
"""Pose type of the pairs for motions that are none."""


def pair(rng, count, kind="general", **options):
    return pair_of_type(rng, count, SCENE.get(kind, kind), **options)


def swapped(m: Matches) -> Matches:
    """The same pair with the images exchanged."""
    return Matches(
        pixels1=m.pixels2,
        pixels2=m.pixels1,
        rays1=m.rays2,
        rays2=m.rays1,
        jacobians1=m.jacobians2,
        jacobians2=m.jacobians1,
        sigma1_px=m.sigma2_px,
        sigma2_px=m.sigma1_px,
        board_index=m.board_index,
        grid=m.grid,
        K1=m.K2,
        K2=m.K1,
        A21=None if m.A21 is None else np.linalg.inv(m.A21).astype(np.float64),
        sigma_A=m.sigma_A,
    )


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("weights", ["points", "noise", "auto", "equal"])
def test_exact_data_give_the_exact_geometry(rng, kind, camera, weights):
    matches, pose, _ = pair(rng, SAMPLE[kind], kind, sigma_A=0.0, camera=camera)
    estimate = fundamental_for(kind).solve(matches, weights)
    assert same_up_to_sign(estimate.E21, essential_from_pose(pose)) < EXACT_REL
    assert np.linalg.norm(estimate.E21) == pytest.approx(1.0)
    assert np.abs(estimate.residuals_px).max() < 1e-6
    assert (
        max(pose_errors_deg(choose_pose(estimate.E21, matches.rays1, matches.rays2, SCENE.get(kind, kind)), pose))
        < 1e-6
    )
    if camera is FISHEYE:
        assert estimate.F21 is None
    else:
        h1, h2 = (np.concatenate([q, np.ones((len(q), 1))], axis=1) for q in (matches.pixels1, matches.pixels2))
        F21 = pixel_fundamental(estimate)
        assert np.linalg.norm(F21) == pytest.approx(1.0)
        line = h1 @ F21.T
        assert np.abs(np.sum(h2 * line, axis=1) / np.linalg.norm(line[:, :2], axis=1)).max() < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_affinities_obey_the_estimated_geometry(rng, kind):
    """A^T n2 + n1 = 0 with the normals of F21 in pixels: the rows are those of the literature."""
    matches, _, _ = pair(rng, SAMPLE[kind], kind, sigma_A=0.0)
    F21 = pixel_fundamental(fundamental_for(kind).solve(matches))
    h1, h2 = (np.concatenate([q, np.ones((len(q), 1))], axis=1) for q in (matches.pixels1, matches.pixels2))
    n2, n1 = (h1 @ F21.T)[:, :2], (h2 @ F21)[:, :2]
    violation = np.einsum("nji,nj->ni", matches.A21, n2) + n1
    assert np.abs(violation).max() < EXACT_REL * np.abs(n1).max()


@pytest.mark.parametrize("kind", KINDS)
def test_degrees_of_freedom(rng, kind):
    """The rank of dE over random members of the solver's set is its number of degrees of freedom."""
    freedom = fundamental_for(kind).degrees_of_freedom
    if kind in ("general", "standard-rows"):
        # Of F; the essential matrices among them have five, and none: with one camera rows are what they are.
        assert freedom == {"general": 7, "standard-rows": 2}[kind]
        return
    _, pose, _ = pair(rng, 3, kind)
    e0 = essential_from_pose(pose)
    step, tangents = 1e-6, []
    y = np.array([0.0, 1.0, 0.0])
    for _ in range(8):
        (a, b), v = rng.normal(size=2), rng.normal(size=3)
        R, t = pose.rotation, unit(pose.translation_mm)
        if kind == "planar":
            R, t = exp_so3(step * a * y) @ R, exp_so3(step * b * y) @ t
        elif kind == "translation":
            t = t + step * v
        elif kind == "forward-roll":
            R = exp_so3(step * a * np.array([0.0, 0.0, 1.0])) @ R
        moved = essential_from_pose(Rigid3(R, t))
        matches, _, _ = pair(rng, 12, kind, pose=Rigid3(R, 300.0 * unit(t)))
        # The solver's set contains the moved geometry: it recovers it exactly.
        found = fundamental_for(kind).solve(matches).E21
        assert same_up_to_sign(found, moved) < EXACT_REL
        tangents.append((moved - e0).ravel() / step)
    rank = np.linalg.matrix_rank(np.array(tangents), tol=1e-3)
    assert rank == freedom


@pytest.mark.parametrize("kind", KINDS)
def test_swapping_the_images_transposes(rng, kind):
    matches, _, _ = pair(rng, 40, kind, noise_px=0.5)
    forward = fundamental_for(kind).solve(matches).E21
    back = fundamental_for(kind).solve(swapped(matches)).E21
    assert same_up_to_sign(forward.T, back) < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_the_scale_of_the_scene_and_of_the_sigmas_does_not_matter(rng, kind):
    pose = pair(rng, 3, kind)[1]
    seed = int(rng.integers(1 << 30))
    first, _, _ = pair(np.random.default_rng(seed), 20, kind, noise_px=0.5, sigma_A=0.05, pose=pose)
    from dataclasses import replace

    second = replace(first, sigma1_px=10 * first.sigma1_px, sigma2_px=10 * first.sigma2_px, sigma_A=10 * first.sigma_A)
    a, b = (fundamental_for(kind).solve(m).E21 for m in (first, second))
    assert same_up_to_sign(a, b) < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_identical_images_have_no_baseline(rng, kind):
    matches, _, _ = pair(rng, 20, kind, noise_px=0.1)
    from dataclasses import replace

    same = replace(matches, pixels2=matches.pixels1, rays2=matches.rays1, jacobians2=matches.jacobians1)
    with pytest.raises(DegenerateError, match=r"no baseline|do not determine|not determined"):
        fundamental_for(kind).solve(same)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("noise_px", [0.0, 0.3])
def test_pure_rotation_is_refused(rng, kind, noise_px):
    matches, _, _ = pair(rng, 40, "general", noise_px=0.0)
    R = exp_so3(np.array([0.02, 0.1, -0.05]))
    target = REGULAR.project(matches.rays1 @ R.T)[0] + rng.normal(size=(40, 2)) * noise_px
    sigma = np.full(40, max(noise_px, 0.01))
    turned = Matches.from_cameras(REGULAR, REGULAR, matches.pixels1, target, sigma1_px=sigma, sigma2_px=sigma)
    with pytest.raises(DegenerateError, match=r"no baseline|do not determine|not determined"):
        fundamental_for(kind).solve(turned)


@pytest.mark.parametrize("noise_px", [0.05, 1.0])
def test_a_plane_leaves_a_general_geometry_open(rng, noise_px):
    for _ in range(20):
        matches, _ = plane_in_sight(rng, noise_px)
        with pytest.raises(DegenerateError, match="one plane"):
            fundamental_for("general").solve(matches)


@pytest.mark.parametrize("weights", [None, "auto", "equal"])
def test_affinities_of_other_planes_close_it(rng, weights):
    """Points of one plane, each on a small facet of its own."""
    matches, pose = plane_in_sight(rng, 0.05)
    X = matches.rays1 * rng.uniform(900.0, 1500.0, (len(matches), 1))
    tangents = np.linalg.svd(unit(-X + 0.5 * rng.normal(size=X.shape))[:, None, :])[2][:, 1:].swapaxes(1, 2)
    depth1, depth2 = _depths(matches, pose)
    J1, J2 = (
        REGULAR.project_with_jacobians(rays * depth[:, None])[2]
        for rays, depth in ((matches.rays1, depth1), (matches.rays2, depth2))
    )
    A21 = (J2 @ pose.rotation @ tangents) @ np.linalg.inv(J1 @ tangents)
    found = fundamental_for("general").solve(matches.with_affinities(A21, np.full(len(matches), 1e-3)), weights)
    assert same_up_to_sign(found.E21, essential_from_pose(pose)) < 0.05


def _depths(matches, pose):
    """Distances along the rays (N,) of both cameras where they meet, in mm."""
    columns = np.stack([matches.rays1 @ pose.rotation.T, -matches.rays2], axis=-1)
    return (np.linalg.pinv(columns) @ -pose.translation_mm).T


@pytest.mark.parametrize(("kind", "count"), [("general", 7), ("planar", 2), ("translation", 1)])
def test_too_few_matches_are_refused_with_the_number(rng, kind, count):
    matches, _, _ = pair(rng, count, kind)
    with pytest.raises(InputError, match="are needed"):
        fundamental_for(kind).solve(matches, "points")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", KINDS)
def test_no_matches_are_refused(rng, kind):
    with pytest.raises(InputError, match="no matches"):
        fundamental_for(kind).solve(pair(rng, 1)[0].select(np.zeros(0, dtype=np.int64)))


@pytest.mark.parametrize("kind", KINDS)
def test_the_rule_auto_finds_the_noise_of_the_affinities(rng, kind):
    matches, _, _ = pair(rng, 200, kind, noise_px=0.2, sigma_A=0.01)
    estimate = fundamental_for(kind).solve(matches, "auto")
    # The median of 400 numbers is known to 6 %.
    assert estimate.weights.sigma_A == pytest.approx(np.full(200, 0.01), rel=0.25)


def test_affine_correspondences_need_fewer(rng):
    for kind, count in (("general", 3), ("planar", 1), ("translation", 1)):
        matches, pose, _ = pair(rng, count, kind, sigma_A=0.0)
        found = fundamental_for(kind).solve(matches).E21
        assert same_up_to_sign(found, essential_from_pose(pose)) < 1e-6, kind


def test_inputs_are_left_alone_and_affinities_without_sigma_ignored(rng):
    from dataclasses import replace

    matches, _, _ = pair(rng, 20, noise_px=0.5, sigma_A=0.05)
    wild = replace(matches, A21=np.full_like(matches.A21, 7.0), sigma_A=None)
    without = fundamental_for("general").solve(replace(matches, A21=None, sigma_A=None)).E21
    assert np.array_equal(fundamental_for("general").solve(wild).E21, without)
    assert np.array_equal(fundamental_for("general").solve(matches, "points").E21, without)
    some = np.array(matches.A21)
    some[::2] = np.nan
    assert np.isfinite(fundamental_for("general").solve(replace(matches, A21=some)).E21).all()


def test_planar_solver_on_standard_and_forward(rng):
    for kind in ("standard", "forward"):
        matches, pose, _ = pair(rng, 20, kind)
        solver = fundamental_for(kind, motion="planar")
        assert same_up_to_sign(solver.solve(matches).E21, essential_from_pose(pose)) < EXACT_REL


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="known: forward, forward-roll, general"):
        fundamental_for("circular")
    with pytest.raises(InputError, match="pose_type_evidence"):
        fundamental_for("auto")


def test_planar_poses_are_two_and_planar(rng):
    _, pose, _ = pair(rng, 3, "planar")
    E = essential_from_pose(pose)
    assert len(hypothesis_poses(E)) == 4
    planar = hypothesis_poses(E, "planar")
    assert len(planar) == 2
    for candidate in planar:
        assert np.abs(candidate.rotation[:, 1] - [0, 1, 0]).max() < 1e-9
        assert (
            same_up_to_sign(unit(skew(candidate.translation_mm).ravel()), unit(skew(pose.translation_mm).ravel()))
            < 1e-9
        )
