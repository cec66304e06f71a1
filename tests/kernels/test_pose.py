"""The kernels of the relative pose against numpy: equal up to rounding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from helpers.epipolar_scenes import FISHEYE, REGULAR, affinities, pair
from kernels.reference import local as reference_local
from kernels.reference import minimal as reference_minimal

from rigkit.cameras.base import Camera
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.kernels.pose import five_rows, six_rows
from rigkit.relative_pose import robust
from rigkit.relative_pose.refinement.local import MarginalLoss, SampsonRows
from rigkit.relative_pose.refinement.pose_problem import PoseProblem, RobustWeights, cauchy_weights
from rigkit.relative_pose.refinement.refine import refine_pose
from rigkit.relative_pose.robust import robust_pose
from rigkit.relative_pose.solvers.pose import essential_from_pose
from rigkit.relative_pose.solvers.rows import affinity_rows, point_rows

SOLUTION = 1e-6
"""Largest difference of two E: both solvers lose digits where two solutions nearly coincide, typically 1e-14."""

SAME_SHARE = 0.999
"""Where two solutions coincide, rounding decides whether they are real."""


@pytest.fixture
def in_numpy(monkeypatch: pytest.MonkeyPatch) -> Callable[..., object]:
    def run(function: Callable[..., object], *args: object, **options: object) -> object:
        with monkeypatch.context() as patch:
            for name in ("residuals", "quality", "quality_ahead", "improved"):
                patch.setattr(SampsonRows, name, getattr(reference_local, name))
            patch.setattr(robust, "five_rows", reference_minimal.essential_from_five_rows)
            patch.setattr(robust, "six_rows", reference_minimal.essential_from_six_rows)
            patch.setattr(PoseProblem, "minimum", PoseProblem._descend)
            return function(*args, **options)

    return run


def _matches(rng: np.random.Generator, kind: str = "general", camera: Camera = REGULAR) -> tuple[Matches, Rigid3]:
    """A fifth of 150 matches wrong, a few without affinity: no multiple of any block of the kernels."""
    m, pose, _ = pair(rng, 150, kind, noise_px=0.4, sigma_A=0.03, camera=camera)
    A21 = np.array(m.A21)
    A21[:7] = np.nan
    wrong = np.where(np.arange(150) % 5 == 0, np.roll(np.arange(150), 5), np.arange(150))
    sigma = rng.uniform(0.3, 0.5, 150)
    return replace(
        m,
        pixels2=m.pixels2[wrong],
        rays2=m.rays2[wrong],
        jacobians2=m.jacobians2[wrong],
        A21=A21,
        sigma1_px=sigma,
        sigma2_px=sigma[::-1],
    ), pose


def _starts(rng: np.random.Generator, pose: Rigid3, count: int = 9) -> np.ndarray:
    turns = exp_so3(rng.normal(0.0, np.radians(1.0), (count, 3)) * [0.0, 1.0, 0.0])
    return np.stack([essential_from_pose(Rigid3(turn @ pose.rotation, pose.translation_mm)) for turn in turns])


def _off(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest difference of matrices (..., 3, 3), whatever their signs."""
    return np.minimum(*(np.abs(a - sign * b).max(axis=(-2, -1)) for sign in (1.0, -1.0)))


@pytest.mark.parametrize("camera", [REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("affine", [0, 1], ids=["5 points", "1 AC + 2 points"])
def test_five_equations(rng, camera, affine, in_numpy):
    m, _, _ = pair(rng, 400, camera=camera, noise_px=0.5, sigma_A=0.03)
    rows = point_rows(m.rays1, m.rays2).reshape(-1, 5, 9)
    if affine:
        more = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, affinities(m))[::5]
        rows = np.concatenate([rows[:, :3], more], axis=1)
    ours, theirs = five_rows(rows), reference_minimal.essential_from_five_rows(rows)
    real = [np.isfinite(found).all(axis=(2, 3)) for found in (ours, theirs)]
    assert real[0].sum() > 3 * len(rows)
    # Two solutions that all but coincide are real or not as the processor rounds.
    same = np.equal(*(found.sum(axis=1) for found in real))
    assert np.mean(same) >= 1.0 - 1.5 / len(rows)
    off = np.asarray(_off(ours[same, :, None], theirs[same, None]))
    mine, others = (np.asarray(found)[same] for found in real)
    off = np.where(mine[:, :, None] & others[:, None], off, np.inf)
    for nearest in (off.min(axis=2)[mine], off.min(axis=1)[others]):
        assert np.mean(nearest < SOLUTION) >= SAME_SHARE
        assert np.median(nearest) < 1e-12


def test_samples_that_determine_nothing_are_survived(rng):
    rows = np.zeros((4, 5, 9))
    rows[1], rows[2, :, 0] = rng.normal(size=9), 1.0
    rows[3] = np.nan
    found = five_rows(rows)
    assert found.shape == (4, 10, 3, 3)
    assert np.isnan(found[3]).all()
    assert six_rows(np.zeros((2, 6, 9))).shape == (2, 1, 3, 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("solve, count", [(five_rows, 5), (six_rows, 6)])
def test_a_number_that_is_none_spoils_its_own_sample_alone(rng, solve, count, bad):
    rows = rng.normal(size=(20, count, 9))
    found = solve(rows)
    rows[::2, rng.integers(count), rng.integers(9)] = bad
    again = solve(rows)
    assert np.isnan(again[::2]).all()
    assert np.array_equal(again[1::2], found[1::2], equal_nan=True)


def test_what_five_equations_find_is_essential(rng):
    # Points seen in pure translation: a sheaf of solutions, where rounding turns signs that no root does.
    m, _, _ = pair(rng, 5000, "standard")
    found = five_rows(point_rows(m.rays1, m.rays2).reshape(-1, 5, 9)).reshape(-1, 3, 3)
    found = found[np.isfinite(found).all(axis=(1, 2))]
    assert len(found) > 1000
    s = np.linalg.svd(found, compute_uv=False)
    assert np.abs(s - [np.sqrt(0.5), np.sqrt(0.5), 0.0]).max() < 10.0 * SOLUTION


def test_six_equations(rng, in_numpy):
    m, _, _ = pair(rng, 200, noise_px=0.5, sigma_A=0.05)
    more = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, affinities(m))
    rows = np.concatenate([point_rows(m.rays1, m.rays2)[:, None], more], axis=1).reshape(-1, 6, 9)
    # Of equations of nothing, the two smallest singular values may be nearly equal.
    rows = np.concatenate([rows, rng.normal(size=(2000, 6, 9))])
    ours, theirs = six_rows(rows), reference_minimal.essential_from_six_rows(rows)
    assert _off(ours, theirs).max() < SOLUTION
    s = np.linalg.svd(ours, compute_uv=False)
    assert np.abs(s - [np.sqrt(0.5), np.sqrt(0.5), 0.0]).max() < 1e-12


@pytest.mark.parametrize("camera", [REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
def test_residuals_and_qualities(rng, camera):
    wild, pose = _matches(rng, camera=camera)
    rows, E21 = SampsonRows.of(wild), np.concatenate([_starts(rng, pose), rng.normal(size=(5, 3, 3))])
    assert rows.residuals(E21) == pytest.approx(reference_local.residuals(rows, E21), rel=1e-9, abs=1e-9)
    for noise in (1.5, 6.0, 24.0):
        ahead = rows.quality_ahead(E21, 5.0, noise)
        assert ahead == pytest.approx(reference_local.quality_ahead(rows, E21, 5.0, noise), rel=1e-9)
        assert (ahead[0] < rows.quality(E21, noise)).any()
        assert rows.quality(E21, noise) == pytest.approx(reference_local.quality(rows, E21, noise), rel=1e-9)


def test_how_arrays_lie_in_memory_does_not_matter(rng):
    wild, pose = _matches(rng)
    turned = [np.swapaxes(np.ascontiguousarray(np.swapaxes(b, 1, 2)), 1, 2) for b in (wild.jacobians1, wild.jacobians2)]
    E21 = _starts(rng, pose)
    same = replace(wild, jacobians1=turned[0], jacobians2=turned[1])
    assert np.array_equal(SampsonRows.of(same).residuals(E21), SampsonRows.of(wild).residuals(E21))


def test_the_precision_of_the_hypotheses_does_not_matter(rng):
    wild, pose = _matches(rng)
    rows = SampsonRows.of(wild)
    E21: np.ndarray = _starts(rng, pose).astype(np.float32)
    same = E21.astype(np.float64)
    assert np.array_equal(rows.residuals(E21), rows.residuals(same))
    assert rows.quality_ahead(E21, 5.0, 6.0) == pytest.approx(rows.quality_ahead(same, 5.0, 6.0), rel=1e-4)
    assert _off(rows.improved(E21, "general", 6.0), rows.improved(same, "general", 6.0)).max() < 1e-5


@pytest.mark.parametrize("kind", ["general", "planar", "standard"])
def test_local_optima(rng, kind):
    wild, pose = _matches(rng, kind)
    rows, starts = SampsonRows.of(wild), _starts(rng, pose)
    ours, theirs = rows.improved(starts, kind, 6.0, 1.5), reference_local.improved(rows, starts, kind, 6.0, 1.5)
    assert ours.shape == (2, 9, 3, 3)
    # A step that is taken or not by rounding ends within what counts as settled.
    assert _off(ours, theirs).max() < 1e-5


@pytest.mark.parametrize("robust", [None, cauchy_weights, MarginalLoss(2.0)], ids=["squares", "Cauchy", "marginal"])
@pytest.mark.parametrize("kind", ["general", "planar", "standard"])
@pytest.mark.parametrize("affine", [False, True], ids=["points", "affine"])
def test_refinement(rng, kind: str, robust: RobustWeights | None, affine: bool, in_numpy):
    wild, pose = _matches(rng, kind)
    given = wild if affine else replace(wild, A21=None, sigma_A=None)
    start = Rigid3(exp_so3([0.0, 0.002, 0.0]) @ pose.rotation, pose.translation_mm)
    own = rng.uniform(0.5, 1.0, len(wild))
    ours = refine_pose(given, start, kind, robust=robust, point_weights=own)
    theirs = in_numpy(refine_pose, given, start, kind, robust=robust, point_weights=own)
    assert (ours.iterations, ours.converged) == (theirs.iterations, theirs.converged)
    # Against a fifth of gross errors least squares converge slowly: where the steps end, rounding still shows.
    assert ours.cam2_from_cam1.matrix() == pytest.approx(theirs.cam2_from_cam1.matrix(), abs=1e-8)
    assert ours.covariance == pytest.approx(theirs.covariance, rel=1e-6, abs=1e-15)
    assert ours.weights == pytest.approx(theirs.weights, abs=1e-7)
    for name in ("sampson_rms_px", "cost", "variance_factor"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), rel=1e-7)


@pytest.mark.parametrize("sample", ["points", "affine"])
@pytest.mark.parametrize("kind", ["general", "planar"])
def test_the_whole_search_ends_at_the_same_pose(rng, kind, sample, in_numpy):
    wild, _ = _matches(rng, kind)
    ours = robust_pose(wild, np.random.default_rng(1), pose_type=kind, sample=sample)
    theirs = in_numpy(robust_pose, wild, np.random.default_rng(1), pose_type=kind, sample=sample)
    off = ours.refined.cam2_from_cam1.matrix() - theirs.refined.cam2_from_cam1.matrix()
    # The noise level follows from the best hypothesis, known to what counts as settled.
    assert np.abs(off).max() < 1e-5
