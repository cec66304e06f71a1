"""From correspondences of any scene to an oriented cloud: the pipeline for pairs without chessboards.

Correspondences of natural images are contaminated and their stated sigmas optimistic. A robust search finds the pose
that most points agree with; what the agreeing ones then show is the noise of points and affinities, with which the
likelihood of points and affinities together refines the pose. No square gives the scale: lengths are in baselines
unless the baseline is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.affinities import Affinities, EpipolarNormals
from rigkit.affine.correspondences import Correspondences
from rigkit.affine.registry import affines_from_directions
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError, InputError, RigkitError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.sampson import sampson_distances
from rigkit.optim.robust_scale import MEDIAN_OF_NORMAL, MEDIAN_OF_RAYLEIGH
from rigkit.reconstruction.geometry import decide_pose_type
from rigkit.reconstruction.metric import triangulate_matches
from rigkit.reconstruction.reconstruct import Reconstruction, colours_at, oriented_cloud
from rigkit.relative_pose.refinement.marginal import marginal_quality
from rigkit.relative_pose.refinement.refine import RefinedPose, cauchy_weights, refine_pose
from rigkit.relative_pose.robust.a_contrario import log_false_alarms
from rigkit.relative_pose.robust.robust import RobustPose, Sample, robust_pose
from rigkit.relative_pose.solvers.estimate import check_baseline
from rigkit.relative_pose.solvers.pose import essential_from_pose
from rigkit.relative_pose.solvers.registry import fundamental_for
from rigkit.relative_pose.solvers.weights import affinity_distances, affinity_residuals, usable_affinities

__all__ = ["SceneReconstruction", "reconstruct_scene"]

MIN_MATCHES = 8
"""Fewer that agree are chance among many that do not."""
MAX_NOISE = 6.0
"""Noise of points, in their stated sigmas, up to which they can agree with a pose."""
GATE = 3.3
"""In standard deviations: one good point in a thousand is lost."""
AFFINITY_GATE = 3.7
"""The same for the length of two residuals."""
SCENE_ROUNDS = 4
MAX_FALSE_ALARMS = 1e-2
MAX_RANGE_SIGMA = 0.3
"""A point whose distance is known no better than this share of it is left out: it could be anywhere along its ray."""
SAMPLE_KINDS: tuple[Sample, ...] = ("points", "affine")


@dataclass(frozen=True, eq=False, slots=True)
class SceneReconstruction:
    """What the pipeline found for one pair of views of any scene.

    Attributes
    ----------
    reconstruction : pose, matches and cloud as for a pair with boards, without boards. Lengths are in mm, or in
        baselines where `metric` is False.
    metric : the baseline was given.
    inliers : (N,) bool, which of the correspondences fit the pose; row n of the cloud belongs to the n-th of `kept`.
    kept : (K,) indices of the correspondences in the cloud.
    sigma_px : standard deviation of the points per axis that the inliers show (median of all).
    sigma_A : the same of an entry of their affinities; NaN where these were computed from directions and the pose.
    """

    reconstruction: Reconstruction
    metric: bool
    inliers: BoolArray
    kept: NDArray[np.int64]
    sigma_px: float
    sigma_A: float


def reconstruct_scene(
    correspondences: Correspondences,
    camera1: Camera,
    camera2: Camera,
    *,
    pair_id: str = "scene",
    pose_type: PoseType | str = PoseType.GENERAL,
    level_sigma_rad: float | None = None,
    baseline_mm: float | None = None,
    image1: NDArray[np.generic] | None = None,
    seed: int = 0,
) -> SceneReconstruction:
    """Reconstruct two views of any scene from point correspondences with affinities or directions.

    Parameters
    ----------
    correspondences : may be contaminated; their sigmas are only believed relative to each other.
    camera1, camera2 : calibrated cameras, one object twice where one camera was moved.
    pair_id : for messages.
    pose_type, level_sigma_rad : as for `reconstruct_pair`.
    baseline_mm : length of the baseline where it was measured: then the cloud is in mm.
    image1 : image of camera 1: colours of the cloud.
    seed : of the robust search.

    Raises
    ------
    InputError
        Too few correspondences, neither affinities nor directions, or a baseline that is not positive.
    DegenerateError
        Too few of them agree with any pose; no baseline.
    """
    matches, seen = _matches(correspondences, camera1, camera2, baseline_mm, pair_id)
    try:
        fit = _fit(matches, PoseType(pose_type), level_sigma_rad, np.random.default_rng(seed))
        affinities = _affinities(correspondences.select(seen), fit)
        cloud, chosen = _cloud(fit, affinities, baseline_mm, image1)
    except DegenerateError as error:
        raise DegenerateError(f"'{pair_id}': {error}") from error
    scale = 1.0 if baseline_mm is None else baseline_mm
    reconstruction = Reconstruction(
        pair_id=pair_id,
        pose_type=fit.pose_type,
        affine_method="directions" if correspondences.A21 is None else "given affinities",
        camera1=camera1,
        camera2=camera2,
        boards=(),
        matches=fit.matches.with_affinities(affinities.A21, fit.matches.sigma_A).select(chosen),
        pixels1=matches.pixels1[chosen],
        pixels2=matches.pixels2[chosen],
        cam2_from_cam1=_scaled(fit.refined.cam2_from_cam1, scale),
        pose_covariance=_scaled_covariance(fit.refined.covariance, scale),
        E21=essential_from_pose(fit.refined.cam2_from_cam1),
        cloud=cloud,
        baseline_mm=scale,
        baseline_sigma_mm=0.0,
        sampson_rms_px=fit.refined.sampson_rms_px,
        notes=_notes(fit, seen, baseline_mm),
        level_sigma_rad=fit.level_sigma_rad,
    )
    return _with_scatter(reconstruction, fit, np.flatnonzero(seen), chosen, len(seen), metric=baseline_mm is not None)


def _with_scatter(
    reconstruction: Reconstruction,
    fit: _ScenePose,
    seen: NDArray[np.int64],
    chosen: NDArray[np.int64],
    count: int,
    *,
    metric: bool,
) -> SceneReconstruction:
    """Return the reconstruction with what refers to the `count` correspondences: `seen` of them have matches, `chosen`
    of these are in the cloud."""
    inliers = np.zeros(count, dtype=bool)
    inliers[seen[fit.inliers]] = True
    sigma_A = fit.matches.sigma_A
    return SceneReconstruction(
        reconstruction,
        metric,
        inliers,
        seen[chosen],
        float(np.median(fit.matches.sigma1_px[fit.inliers])),
        float("nan") if sigma_A is None else float(np.median(sigma_A[fit.inliers])),
    )


def _matches(
    correspondences: Correspondences, camera1: Camera, camera2: Camera, baseline_mm: float | None, pair_id: str
) -> tuple[Matches, BoolArray]:
    """Return the matches and which of the correspondences have one. Raises InputError where these cannot be used."""
    _check(correspondences, baseline_mm, pair_id)
    matches, seen = correspondences.matches(camera1, camera2)
    if seen.sum() < MIN_MATCHES:
        raise InputError(
            f"'{pair_id}': {int(seen.sum())} of {len(seen)} correspondences lie in both cameras' fields of view; at "
            f"least {MIN_MATCHES} are needed"
        )
    return matches, seen


def _notes(fit: _ScenePose, seen: BoolArray, baseline_mm: float | None) -> tuple[str, ...]:
    notes = list(fit.notes)
    if not seen.all():
        notes.append(f"{int((~seen).sum())} correspondences lie outside the calibrated field of view")
    if baseline_mm is None:
        notes.append("no baseline is given: lengths are in baselines, not in mm")
    return tuple(notes)


def _check(correspondences: Correspondences, baseline_mm: float | None, pair_id: str) -> None:
    if baseline_mm is not None and not (np.isfinite(baseline_mm) and baseline_mm > 0.0):
        raise InputError(f"'{pair_id}': the baseline must be positive, got {baseline_mm} mm")
    if correspondences.A21 is None and correspondences.directions is None:
        raise InputError(
            f"'{pair_id}': the correspondences have neither affinities nor directions, without which there are no "
            "normals; add columns a11, a12, a21, a22 or du1_1, dv1_1, ..."
        )


@dataclass(frozen=True, eq=False, slots=True)
class _ScenePose:
    """The pose of contaminated matches; `matches` are all of them, with the sigmas that the inliers show."""

    matches: Matches
    refined: RefinedPose
    inliers: BoolArray
    pose_type: PoseType
    level_sigma_rad: float | None
    notes: tuple[str, ...]


def _fit(matches: Matches, declared: PoseType, level_sigma_rad: float | None, rng: np.random.Generator) -> _ScenePose:
    """Return the pose that most matches agree with, refined on those by points and affinities."""
    found = _search(matches, PoseType.GENERAL if declared is PoseType.AUTO else declared, rng)
    inliers = found.inliers
    _require(inliers)
    pose, pose_type = found.refined.cam2_from_cam1, declared
    notes: list[str] = []
    for k in range(SCENE_ROUNDS):
        matches = _with_shown_noise(matches, pose, inliers)
        fitting = matches.select(inliers)
        if k == 0:
            check_baseline(fitting)
            decision = decide_pose_type(fitting, declared, level_sigma_rad)
            pose_type, level_sigma_rad = decision.pose_type, decision.level_sigma_rad
            notes += decision.notes
        refined = refine_pose(fitting, pose, pose_type, level_sigma_rad, robust=cauchy_weights)
        pose = refined.cam2_from_cam1
        inliers = _agreeing(matches, pose)
        _require(inliers)
    _a_contrario_test(matches, pose, inliers, fundamental_for(pose_type).degrees_of_freedom)
    return _ScenePose(matches, refined, inliers, pose_type, level_sigma_rad, tuple(notes))


def _search(matches: Matches, kind: PoseType, rng: np.random.Generator) -> RobustPose:
    """Return the better of the poses found from samples of points and from samples of affine correspondences.

    Points lead to the optimum surely where most matches are right; where few are, the small samples still find it.
    """
    best: tuple[float, RobustPose] | None = None
    failure: RigkitError | None = None
    for sample in SAMPLE_KINDS:
        if sample == "affine" and usable_affinities(matches).sum() < MIN_MATCHES:
            continue
        try:
            found = robust_pose(matches, rng, pose_type=kind, sample=sample, max_noise=MAX_NOISE)
        except RigkitError as error:
            failure = error
            continue
        r = _in_sigmas(matches, found.refined.cam2_from_cam1)
        quality = float(marginal_quality(r, MAX_NOISE).sum())
        if best is None or quality > best[0]:
            best = quality, found
    if best is None:
        # Of a camera that did not move at all every sample fails: the reason is worth more than that.
        check_baseline(matches)
        raise failure or DegenerateError("no pose found")
    return best[1]


def _require(inliers: BoolArray) -> None:
    if inliers.sum() < MIN_MATCHES:
        raise DegenerateError(
            f"only {int(inliers.sum())} of {len(inliers)} correspondences agree with one pose; check that the images "
            "show the same scene, and the cameras"
        )


def _a_contrario_test(matches: Matches, pose: Rigid3, inliers: BoolArray, freedom: int) -> None:
    """Raise DegenerateError where as many of so many wrong matches would be expected to agree with some pose."""
    affinity = _affinity_in_sigmas(matches, pose)
    # A match without an affinity always passes that test.
    fits = ~(np.nan_to_num(affinity) >= AFFINITY_GATE)
    if log_false_alarms(matches, pose, inliers, fits, freedom, GATE) > np.log(MAX_FALSE_ALARMS):
        raise DegenerateError(
            f"{int(inliers.sum())} of {len(inliers)} correspondences agree with one pose, as many as wrong ones might "
            "by chance; the scene has too little texture, or looks the same in many places"
        )


def _in_sigmas(matches: Matches, pose: Rigid3) -> FloatArray:
    m = matches
    E21 = essential_from_pose(pose)
    return sampson_distances(E21, m.rays1, m.rays2, m.jacobians1, m.jacobians2, m.sigma1_px, m.sigma2_px)


def _agreeing(matches: Matches, pose: Rigid3) -> BoolArray:
    """Return which matches fit by their point, and by their affinity where they have one.

    A wrong partner that lies on the epipolar line by chance can turn the pose; its affinity gives it away.
    """
    doubt = _affinity_in_sigmas(matches, pose)
    good = np.abs(_in_sigmas(matches, pose)) < GATE
    return np.asarray(good & ~(np.nan_to_num(doubt) >= AFFINITY_GATE))


def _affinity_in_sigmas(matches: Matches, pose: Rigid3) -> FloatArray:
    return affinity_distances(matches, essential_from_pose(pose))


def _with_shown_noise(matches: Matches, pose: Rigid3, inliers: BoolArray) -> Matches:
    """Return the matches with sigmas as large as the residuals of the inliers from `pose` show them to be."""
    m = matches
    # The pose's five degrees of freedom were fitted to the residuals.
    few = np.sqrt(inliers.sum() / (inliers.sum() - 5.0))
    factor = max(float(np.median(np.abs(_in_sigmas(m, pose)[inliers]))) / MEDIAN_OF_NORMAL * few, 1e-6)
    return replace(
        m,
        sigma1_px=factor * m.sigma1_px,
        sigma2_px=factor * m.sigma2_px,
        sigma_A=None if m.A21 is None else _shown_sigma_A(m, pose, inliers),
    )


def _shown_sigma_A(matches: Matches, pose: Rigid3, inliers: BoolArray) -> FloatArray:
    """Return sigma_A (N,): that which the residuals show, for all the same or in proportion to what was stated.

    The more likely of the two is taken; a stated sigma_A knows the image's noise, but not how flat the surface is.
    """
    size = np.linalg.norm(affinity_residuals(matches, essential_from_pose(pose)), axis=1)
    of = inliers & np.isfinite(size)
    if not of.any():
        return np.full(len(matches), np.nan)
    shapes = [np.ones(len(matches))]
    stated = matches.sigma_A
    if stated is not None and (stated[of] > 0.0).all() and np.isfinite(stated[of]).all():
        shapes += [np.sqrt(stated), np.asarray(stated)]
    best = None
    for shape in shapes:
        with np.errstate(invalid="ignore"):
            factor = max(float(np.median(size[of] / shape[of])) / MEDIAN_OF_RAYLEIGH, 1e-6)
        cost = float(np.sum(np.log(factor * shape[of])))
        if best is None or cost < best[0]:
            best = cost, factor * shape
    assert best is not None
    return best[1]


def _affinities(found: Correspondences, fit: _ScenePose) -> Affinities:
    """Return the affinities of all matches that fit: given ones, and from directions and the pose where none is.

    Those from the pose fulfil the epipolar geometry whatever their error: only given ones have a sigma.
    """
    m, E21 = fit.matches, essential_from_pose(fit.refined.cam2_from_cam1)
    n = len(m)
    A21, covariance = np.full((n, 2, 2), np.nan), np.full((n, 4, 4), np.nan)
    if m.A21 is not None and m.sigma_A is not None:
        good = usable_affinities(m) & np.isfinite(m.sigma_A)
        A21[good] = m.A21[good]
        covariance[good] = m.sigma_A[good, None, None] ** 2 * np.eye(4)
    if found.directions is not None:
        epipolar = EpipolarNormals.from_rays(m.rays1, m.jacobians1, m.rays2, m.jacobians2, E21)
        computed = affines_from_directions(found.directions, "F3UDIR", epipolar=epipolar).A21
        A21 = np.where(np.isfinite(A21), A21, computed)
    A21[~fit.inliers] = np.nan
    return Affinities(A21, np.isfinite(A21).all(axis=(1, 2)), np.full(n, np.nan), covariance)


def _cloud(
    fit: _ScenePose, affinities: Affinities, baseline_mm: float | None, image1: NDArray[np.generic] | None
) -> tuple[OrientedCloud, NDArray[np.int64]]:
    """Return the cloud and which matches are in it."""
    scale = 1.0 if baseline_mm is None else baseline_mm
    pose = _scaled(fit.refined.cam2_from_cam1, scale)
    covariance = _scaled_covariance(fit.refined.covariance, scale)
    points = triangulate_matches(fit.matches, pose, covariance)
    colours = colours_at(image1, fit.matches.pixels1)
    cloud, kept = oriented_cloud(points, fit.matches, pose, covariance, affinities, colours=colours)
    sure = cloud.sigma_mm < MAX_RANGE_SIGMA * np.linalg.norm(cloud.points_mm, axis=1)
    if not sure.any():
        raise DegenerateError("no point's distance is known; the baseline is too short for this scene")
    return _select(cloud, sure), np.flatnonzero(kept)[sure]


def _select(cloud: OrientedCloud, which: BoolArray) -> OrientedCloud:
    return OrientedCloud(
        points_mm=cloud.points_mm[which],
        normals=cloud.normals[which],
        colours=cloud.colours[which],
        board_index=cloud.board_index[which],
        grid=cloud.grid[which],
        sigma_mm=cloud.sigma_mm[which],
        normal_sigma_rad=cloud.normal_sigma_rad[which],
        board_ids=cloud.board_ids,
    )


def _scaled(pose: Rigid3, scale: float) -> Rigid3:
    return Rigid3(pose.rotation, scale * pose.translation_mm)


def _scaled_covariance(covariance: FloatArray, scale: float) -> FloatArray:
    by = np.repeat([1.0, scale], 3)
    return np.asarray(by[:, None] * covariance * by)
