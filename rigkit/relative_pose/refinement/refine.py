"""Maximum likelihood pose from points and affinities, with the pose type as a constraint or as a soft prior.

Levenberg-Marquardt on the five degrees of freedom of the relative pose. The pose type is either exact (planar motion
has two degrees of freedom, standard and forward none) or, with `level_sigma_rad`, a Gaussian prior on the deviations
from it, such as those of cameras set up with a spirit level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType, axis_of
from rigkit.core.printing import brief
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.geometry.sampson import epipolar_normals, sampson_of_matches
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.relative_pose.refinement.pose_problem import PoseMinimum, PoseProblem, RobustWeights
from rigkit.relative_pose.refinement.residuals import whitened_affinities
from rigkit.relative_pose.solvers.planar_ambiguity import ambiguous_poses, compare_poses
from rigkit.relative_pose.solvers.pose import cheirality_margin, choose_pose, essential_from_pose, pose_directions
from rigkit.relative_pose.solvers.registry import fundamental_for
from rigkit.relative_pose.solvers.weights import MIN_SIGMA_A, WeightRule, estimate_sigma_A, usable_affinities

SIGNIFICANT = 3.0
"""Smallest difference of two poses' costs, in standard deviations, that rules out the worse pose."""
POSE_FREEDOM = 5
"""Degrees of freedom of a relative pose without its length."""
STATED_RESIDUALS = 2.0
"""Weight of the stated sigmas in residuals, those of one corner in one image: a unit-information prior (Kass and
Wasserman, J. Am. Stat. Assoc. 90, 1995) on the variance, conjugate as a scaled inverse chi-square."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RefinedPose:
    """A refined relative pose.

    Attributes
    ----------
    cam2_from_cam1 : pose with |translation| = 1.
    covariance : (6, 6) of (left rotation perturbation rad, translation); rank five, lower under a constraint. It
        assumes the sigmas of the matches; multiply it by `variance_factor` if those are not reliable.
    sampson_rms_px : root mean square of the Sampson distances of all points.
    cost : sum of squared residuals in sigmas, including the prior.
    variance_factor : cost of the data over the redundancy (residuals minus degrees of freedom); 1 for correct sigmas.
    weights : (N,) weights of the squared residuals in the last iteration; 1 unless robust.
    iterations : of the minimisation; `converged` says whether its last step was small.
    """

    cam2_from_cam1: Rigid3
    covariance: FloatArray
    sampson_rms_px: float
    cost: float
    variance_factor: float
    weights: FloatArray
    iterations: int
    converged: bool

    __repr__ = brief


def refine_pose(
    matches: Matches,
    start: Rigid3,
    pose_type: PoseType | str = PoseType.GENERAL,
    level_sigma_rad: float | None = None,
    *,
    robust: RobustWeights | None = None,
    point_weights: FloatArray | None = None,
    level_frames: LevelFrames | None = None,
) -> RefinedPose:
    """Return the pose of maximum likelihood near `start`.

    Raises InputError: fewer residuals than degrees of freedom, or a pose type that cannot be refined ("auto");
    DegenerateError: the start has no baseline, or the pose is not determined.

    Parameters
    ----------
    matches : affinities with a sigma_A are used. Leave sigma_A out for affinities that were computed from the epipolar
        geometry or from the same corners.
    start : initial pose; the length of its translation is ignored.
    pose_type : exact constraint; a prior with `level_sigma_rad`.
    level_sigma_rad : standard deviation of each deviation from the pose type.
    robust : weight function for matches with outliers, for example `cauchy_weights`.
    point_weights : (N,) fixed weights of the squared residuals of each match.
    level_frames : frames to which the pose type refers; None: those of the cameras.
    """
    if str(pose_type) not in ("general", "planar", "standard", "forward"):
        raise InputError(
            f"pose type '{pose_type}' cannot be refined; decide on one of general, planar, standard, forward"
        )
    if level_sigma_rad is not None and not level_sigma_rad > 0.0:
        raise InputError(f"level sigma must be positive, got {level_sigma_rad} rad; leave it out for an exact level")
    if level_frames is not None:
        matches, start = level_frames.matches(matches), level_frames.level_pose(start)
    exact = level_sigma_rad is None
    problem = PoseProblem(matches, str(pose_type), level_sigma_rad, robust, point_weights)
    R, t = project_to_type(start, pose_type) if exact else _split(start)
    found = _result(problem, problem.minimum(R, t))
    if level_frames is None:
        return found
    pose = level_frames.camera_pose(found.cam2_from_cam1)
    return replace(found, cam2_from_cam1=pose, covariance=level_frames.camera_covariance(found.covariance))


def estimate_pose(
    matches: Matches,
    pose_type: PoseType | str = PoseType.GENERAL,
    level_sigma_rad: float | None = None,
    *,
    weights: WeightRule | None = None,
) -> RefinedPose:
    """Return the pose without an initial one: linear solution, cheirality, maximum likelihood.

    With a prior the minimisation starts from the solution of the exact pose type and from the general one, and the
    better result is returned. The rule "auto" estimates sigma_A from the data.
    """
    if str(pose_type) == PoseType.GENERAL:
        level_sigma_rad = None
    kinds = [str(pose_type)] if level_sigma_rad is None else [str(pose_type), "general"]
    starts: list[Rigid3] = []
    failure: DegenerateError | InputError | None = None
    for kind in kinds:
        try:
            estimate = fundamental_for(kind).solve(matches, weights)
            starts.append(choose_pose(estimate.E21, matches.rays1, matches.rays2, kind))
        except (DegenerateError, InputError) as error:
            failure = failure or error
    flat = ambiguous_poses(matches) if "general" in kinds else ()
    starts += flat
    matches = _with_sigma(matches, starts, weights)
    ends: list[RefinedPose] = []
    for start in starts:
        try:
            ends.append(refine_pose(matches, start, pose_type, level_sigma_rad))
        except DegenerateError as error:
            failure = failure or error
    if not ends:
        raise failure or DegenerateError("no pose found")
    best = min(ends, key=lambda end: _cost_with_cheirality(matches, end))
    if flat:
        _refuse_ambiguity(matches, best, ends)
    return best


def _cost_with_cheirality(matches: Matches, end: RefinedPose) -> float:
    """Return the cost plus that of moving the points behind a camera to infinity."""
    return end.cost + float(np.sum(end.weights * cheirality_margin(matches, end.cam2_from_cam1) ** 2))


def _refuse_ambiguity(matches: Matches, best: RefinedPose, ends: list[RefinedPose]) -> None:
    """Raise DegenerateError if another pose explains the points of one plane as well as the best one."""
    for end in ends:
        turn, same = compare_poses(best.cam2_from_cam1, end.cam2_from_cam1)
        if not same and not rules_out(matches, best, end):
            raise DegenerateError(
                f"all {len(matches)} points lie on one plane and two poses {np.degrees(turn):.1f} deg apart "
                "explain them equally well; add a board that is not parallel to it, or declare the pose type"
            )


def rules_out(matches: Matches, better: RefinedPose, worse: RefinedPose) -> bool:
    """Return whether the cost of the worse pose is significantly higher than that of the better one."""
    chance = _cost_difference_sigma(matches, better.cam2_from_cam1, worse.cam2_from_cam1)
    difference = _cost_with_cheirality(matches, worse) - _cost_with_cheirality(matches, better)
    return difference >= SIGNIFICANT * max(better.variance_factor, 1.0) * chance


def _cost_difference_sigma(matches: Matches, first: Rigid3, second: Rigid3) -> float:
    """Return the standard deviation of the difference of two poses' costs that noise alone would cause.

    A residual is the noise across an epipolar line, whose direction depends on the pose. For two standard normal
    residuals with correlation c the mean square difference of their squares is 4 (1 - c^2). SIGNIFICANT^2 is added for
    the error of the pose itself.
    """
    m, which = matches, whitened_affinities(matches)[1]
    lines1, lines2 = [], []
    for pose in (first, second):
        _, n1, n2 = epipolar_normals(essential_from_pose(pose), m.rays1, m.rays2, m.jacobians1, m.jacobians2)
        lines1.append(unit(np.concatenate([m.sigma1_px[:, None] * n1, m.sigma2_px[:, None] * n2], axis=1)))
        lines2.append(unit(n2[which]))
    independent = [1.0 - np.nan_to_num(np.sum(a * b, axis=1)) ** 2 for a, b in (lines1, lines2)]
    return float(np.sqrt(SIGNIFICANT**2 + 4.0 * independent[0].sum() + 8.0 * independent[1].sum()))


def project_to_type(pose: Rigid3, pose_type: PoseType | str) -> tuple[FloatArray, FloatArray]:
    """Return rotation (3, 3) and unit translation (3,) of the pose of type `pose_type` nearest to `pose`."""
    R, t = _split(pose)
    kind = str(pose_type)
    if kind == PoseType.PLANAR:
        angle = np.arctan2(R[0, 2] - R[2, 0], R[0, 0] + R[2, 2])
        R, t = exp_so3(np.array([0.0, angle, 0.0])), np.array([t[0], 0.0, t[2]])
    elif (along := axis_of(kind)) is not None:
        R, t = np.eye(3), np.where(np.arange(3) == along, t, 0.0)
    if not np.linalg.norm(t) > 1e-6:
        raise DegenerateError(f"the start of the refinement has no translation that pose type '{kind}' allows")
    return R, unit(t)


def _split(pose: Rigid3) -> tuple[FloatArray, FloatArray]:
    if not np.linalg.norm(pose.translation_mm) > 0.0:
        raise DegenerateError("the start of the refinement has no baseline; take the images from different places")
    return np.array(pose.rotation), unit(pose.translation_mm)


def _with_sigma(matches: Matches, starts: Sequence[Rigid3], weights: WeightRule | None) -> Matches:
    """Return the matches with the sigma_A of the weight rule; "auto" takes the smallest estimate over all starts."""
    if weights == "points" or (weights == "auto" and not usable_affinities(matches).any()):
        return replace(matches, A21=None, sigma_A=None)
    if weights == "auto" and starts:
        least = min(estimate_sigma_A(matches, essential_from_pose(start)) for start in starts)
        return replace(matches, sigma_A=np.full(len(matches), max(least, MIN_SIGMA_A)))
    return matches


def _result(problem: PoseProblem, end: PoseMinimum) -> RefinedPose:
    matches, root, freedom = problem.matches, np.sqrt(end.weights), len(problem.free())
    r, J = end.residuals * root, end.jacobian[:, problem.free()] * root[:, None]
    gram = J.T @ J
    if freedom and np.linalg.eigvalsh(gram)[0] <= 1e-14 * np.trace(gram):
        raise DegenerateError(
            "the matches do not determine the pose (all on one plane in a critical position, or no baseline); "
            "add points off that plane or declare the pose type"
        )
    spread = pose_directions(end.t)[problem.free()].T
    covariance = spread @ np.linalg.inv(gram) @ spread.T if freedom else np.zeros((6, 6))
    data, n = r[: len(r) - end.priors], len(matches)
    pose = Rigid3(end.R, end.t)
    px = sampson_of_matches(essential_from_pose(pose), matches)
    return RefinedPose(
        cam2_from_cam1=pose,
        covariance=covariance,
        sampson_rms_px=float(np.sqrt(np.mean(px**2))),
        cost=float(r @ r),
        variance_factor=float(data @ data) / max(len(r) - freedom, 1),
        weights=end.weights[:n],
        iterations=end.iterations,
        converged=end.converged,
    )


def variance_factor(sum_of_squares: float, freedom: int) -> float:
    """Return the posterior mean of observed over stated variance, 1 without redundancy.

    `sum_of_squares` is that of the residuals in stated sigmas, `freedom` their number less that of fitted parameters.
    """
    freedom = max(freedom, 0)
    return (sum_of_squares * (freedom > 0) + STATED_RESIDUALS) / (freedom + STATED_RESIDUALS)
