"""Estimate the pose from correspondences with outliers: robust search, then maximum likelihood on the inliers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rigkit.cameras.uncertain import PosedPair
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import DegenerateError, InputError, RigkitError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import rotation_angle
from rigkit.geometry.sampson import sampson_of_matches
from rigkit.optim.robust_scale import MEDIAN_OF_NORMAL, MEDIAN_OF_RAYLEIGH
from rigkit.reconstruction.geometry import decide_pose_type
from rigkit.reconstruction.moved_cameras import visible_in_all
from rigkit.relative_pose.refinement.local import QUANTILE, marginal_quality
from rigkit.relative_pose.refinement.pose_problem import cauchy_weights
from rigkit.relative_pose.refinement.refine import RefinedPose, refine_pose
from rigkit.relative_pose.robust import RobustPose, Sample, log_false_alarms, robust_pose
from rigkit.relative_pose.solvers.estimate import check_baseline
from rigkit.relative_pose.solvers.pose import essential_from_pose
from rigkit.relative_pose.solvers.registry import fundamental_for
from rigkit.relative_pose.solvers.weights import affinity_distances, affinity_residuals, usable_affinities

MIN_MATCHES = 8
"""Fewer inliers can agree by chance."""
MAX_NOISE = 6.0
"""Largest noise of inliers, in their stated sigmas."""
GATE = 3.3
"""Inlier threshold in standard deviations: one inlier in a thousand is lost."""
AFFINITY_GATE = 3.7
"""The same for the norm of an affinity's two residuals."""
SCENE_ROUNDS = 4
CONTRADICTION = 1.5
"""Ratio of another pose's inliers to the measured pose's from which the measured one is wrong."""
MAX_FALSE_ALARMS = 1e-2
SAMPLE_KINDS: tuple[Sample, ...] = ("points", "affine")


@dataclass(frozen=True, eq=False, slots=True)
class ScenePose:
    """The pose of matches with outliers; `matches` are all, with sigmas scaled to the inliers' residuals."""

    matches: Matches
    refined: RefinedPose
    inliers: BoolArray
    pose_type: PoseType
    level_sigma_rad: float | None
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False, slots=True)
class KnownPose:
    """A measured pose, mm.

    Attributes
    ----------
    cam2_from_cam1 : used without refinement.
    covariance : (6, 6) of (left rotation perturbation rad, translation mm); exact by default.
    moved : cameras and pose moved by one standard deviation along each principal axis of their covariance, which widens
        the inlier threshold.
    """

    cam2_from_cam1: Rigid3
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    moved: tuple[PosedPair, ...] = ()

    @property
    def baseline_mm(self) -> float:
        """Length of the translation."""
        return float(np.linalg.norm(self.cam2_from_cam1.translation_mm))

    def epipolar_sigma_px(self, matches: Matches) -> FloatArray:
        """Return the standard deviation (N,) px of exact matches' epipolar distances by the uncertainty of the pose and
        the cameras."""
        here = sampson_of_matches(essential_from_pose(self.cam2_from_cam1), matches)
        squares = np.zeros(len(matches))
        for camera1, camera2, pose in self.moved:
            seen = visible_in_all([(camera1, camera2)], matches.pixels1, matches.pixels2)
            there = matches.select(seen).with_cameras(camera1, camera2)
            squares[seen] += (sampson_of_matches(essential_from_pose(pose), there) - here[seen]) ** 2
        return np.sqrt(squares)


def known_scene_pose(matches: Matches, known: KnownPose) -> ScenePose:
    """Return a measured pose, not refined, with its inliers and their noise.

    Raises DegenerateError for too few inliers: the pose, or a camera, is not that of these images.
    """
    length = known.baseline_mm
    pose = Rigid3(known.cam2_from_cam1.rotation, known.cam2_from_cam1.translation_mm / length)
    slack = GATE * known.epipolar_sigma_px(matches) / matches.sigma1_px
    near = np.abs(_in_sigmas(matches, pose)) < np.hypot(QUANTILE * MAX_NOISE, slack)
    _check_inlier_count(near)
    _check_measured_pose(matches, pose, near)
    inliers = near
    for _ in range(SCENE_ROUNDS):
        matches = _with_residual_noise(matches, pose, inliers)
        inliers = near & _inliers(matches, pose)
        _check_inlier_count(inliers)
    px = _in_sigmas(matches, pose)[inliers] * matches.sigma1_px[inliers]
    to_unit = np.repeat([1.0, 1.0 / length], 3)
    refined = RefinedPose(
        cam2_from_cam1=pose,
        covariance=to_unit[:, None] * known.covariance * to_unit,
        sampson_rms_px=float(np.sqrt(np.mean(px**2))),
        cost=float(np.sum((px / matches.sigma1_px[inliers]) ** 2)),
        variance_factor=1.0,
        weights=np.ones(int(inliers.sum())),
        iterations=0,
        converged=True,
    )
    return ScenePose(matches, refined, inliers, PoseType.GENERAL, None, ())


def _check_measured_pose(matches: Matches, pose: Rigid3, near: BoolArray) -> None:
    """Raise DegenerateError if another pose explains many more of the matches than the measured one."""
    try:
        other = _search(matches, PoseType.GENERAL, np.random.default_rng(0)).refined.cam2_from_cam1
    except (InputError, DegenerateError):
        # The matches do not determine a pose, so they cannot contradict the measured one.
        return
    better = np.abs(_in_sigmas(matches, other)) < QUANTILE * MAX_NOISE
    if better.sum() > CONTRADICTION * near.sum():
        turn = np.degrees(rotation_angle(other.rotation @ pose.rotation.T))
        raise DegenerateError(
            f"{int(near.sum())} of {len(matches)} correspondences agree with the measured pose and {int(better.sum())} "
            f"with another, turned by {turn:.2f} deg from it; check which camera took which image, that the pose is "
            "cam2_from_cam1, that both images are of one moment, and that the cameras have not moved since"
        )


def fit_scene_pose(
    matches: Matches,
    declared: PoseType,
    level_sigma_rad: float | None,
    rng: np.random.Generator,
    start: Rigid3 | None = None,
) -> ScenePose:
    """Return the pose with most inliers, refined on these by points and affinities.

    With `start`, a pose that the matches were found with, there is no robust search.
    Raises DegenerateError without a pose, or if the pose is not of the type `declared`.
    """
    try:
        return _estimate(matches, declared, level_sigma_rad, rng, start)
    except DegenerateError as error:
        if declared in (PoseType.AUTO, PoseType.GENERAL) or start is not None:
            raise
        try:
            other = _estimate(matches, PoseType.GENERAL, None, rng, None)
        except (InputError, DegenerateError):
            raise error from None
        pose = other.refined.cam2_from_cam1
        turn = np.degrees(rotation_angle(pose.rotation))
        along = ", ".join(f"{x:.2f}" for x in pose.rotation.T @ -pose.translation_mm)
        raise DegenerateError(
            f"declared '{declared.value}', but {int(other.inliers.sum())} of {len(matches)} correspondences agree with "
            f"a pose that is not: turned by {turn:.2f} deg, moved along ({along}); declare 'general', and how well a "
            "declared type holds with --level-sigma-deg"
        ) from error


def _estimate(
    matches: Matches, declared: PoseType, level_sigma_rad: float | None, rng: np.random.Generator, start: Rigid3 | None
) -> ScenePose:
    pose, pose_type = start, declared
    if pose is None:
        found = _search(matches, PoseType.GENERAL if declared is PoseType.AUTO else declared, rng)
        pose, inliers = found.refined.cam2_from_cam1, found.inliers
    else:
        inliers = np.abs(_in_sigmas(matches, pose)) < QUANTILE * MAX_NOISE
    _check_inlier_count(inliers)
    notes: list[str] = []
    for k in range(SCENE_ROUNDS):
        matches = _with_residual_noise(matches, pose, inliers)
        fitting = matches.select(inliers)
        if k == 0:
            check_baseline(fitting)
            decision = decide_pose_type(fitting, declared, level_sigma_rad)
            pose_type, level_sigma_rad = decision.pose_type, decision.level_sigma_rad
            notes += decision.notes
        refined = refine_pose(fitting, pose, pose_type, level_sigma_rad, robust=cauchy_weights)
        pose = refined.cam2_from_cam1
        inliers = _inliers(matches, pose)
        _check_inlier_count(inliers)
    if start is None:
        _a_contrario_test(matches, pose, inliers, fundamental_for(pose_type).degrees_of_freedom)
    return ScenePose(matches, refined, inliers, pose_type, level_sigma_rad, tuple(notes))


def _search(matches: Matches, kind: PoseType, rng: np.random.Generator) -> RobustPose:
    """Return the better of the poses found from samples of points and from samples of affine correspondences.

    With few outliers, point samples find the optimum reliably; with many, the smaller affine samples still do.
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
        # If the camera did not move every sample fails; this error names the reason.
        check_baseline(matches)
        raise failure or DegenerateError("no pose found")
    return best[1]


def _check_inlier_count(inliers: BoolArray) -> None:
    if inliers.sum() < MIN_MATCHES:
        raise DegenerateError(
            f"only {int(inliers.sum())} of {len(inliers)} correspondences agree with one pose; check that the images "
            "show the same scene, and the cameras"
        )


def _a_contrario_test(matches: Matches, pose: Rigid3, inliers: BoolArray, freedom: int) -> None:
    """Raise DegenerateError if as many random matches would be expected to agree with some pose."""
    affinity = affinity_distances(matches, essential_from_pose(pose))
    # A match without an affinity always passes that test.
    fits = ~(np.nan_to_num(affinity) >= AFFINITY_GATE)
    if log_false_alarms(matches, pose, inliers, fits, freedom, GATE) > np.log(MAX_FALSE_ALARMS):
        raise DegenerateError(
            f"{int(inliers.sum())} of {len(inliers)} correspondences agree with one pose, as many as wrong ones might "
            "by chance; take a scene with more texture, which does not look the same in many places"
        )


def _in_sigmas(matches: Matches, pose: Rigid3) -> FloatArray:
    return sampson_of_matches(essential_from_pose(pose), matches, in_sigmas=True)


def _inliers(matches: Matches, pose: Rigid3) -> BoolArray:
    """Return a mask of the matches that fit by their point, and by their affinity if they have one.

    The affinity reveals a wrong match that is close to its epipolar line by chance.
    """
    affinity = affinity_distances(matches, essential_from_pose(pose))
    good = np.abs(_in_sigmas(matches, pose)) < GATE
    return np.asarray(good & ~(np.nan_to_num(affinity) >= AFFINITY_GATE))


def _with_residual_noise(matches: Matches, pose: Rigid3, inliers: BoolArray) -> Matches:
    """Return the matches with sigmas scaled to the residuals of the inliers of `pose`."""
    m = matches
    # The pose has five degrees of freedom.
    few = np.sqrt(inliers.sum() / (inliers.sum() - 5.0))
    factor = max(float(np.median(np.abs(_in_sigmas(m, pose)[inliers]))) / MEDIAN_OF_NORMAL * few, 1e-6)
    return replace(
        m,
        sigma1_px=factor * m.sigma1_px,
        sigma2_px=factor * m.sigma2_px,
        sigma_A=None if m.A21 is None else _residual_sigma_A(m, pose, inliers),
    )


def _residual_sigma_A(matches: Matches, pose: Rigid3, inliers: BoolArray) -> FloatArray:
    """Return sigma_A (N,) from the residuals: equal for all, or proportional to the stated sigma_A or its square root.

    The likeliest is returned. A stated sigma_A contains the image noise but not the curvature of the surface.
    """
    size = np.linalg.norm(affinity_residuals(matches, essential_from_pose(pose)), axis=1)
    of = inliers & np.isfinite(size)
    if not of.any():
        return np.full(len(matches), np.nan)
    shapes = [np.ones(len(matches))]
    stated = matches.sigma_A
    if stated is not None and (stated[of] > 0.0).all() and np.isfinite(stated[of]).all():
        shapes += [np.sqrt(stated), np.asarray(stated)]
    with np.errstate(invalid="ignore"):
        factors = [max(float(np.median(size[of] / shape[of])) / MEDIAN_OF_RAYLEIGH, 1e-6) for shape in shapes]
    found = [factor * shape for factor, shape in zip(factors, shapes, strict=True)]
    return min(found, key=lambda sigma: float(np.sum(np.log(sigma[of]))))
