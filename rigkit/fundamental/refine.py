"""Maximum likelihood pose from points and affinities, with the pose type as a constraint or as a soft prior.

Levenberg-Marquardt on the five degrees of freedom of the relative pose. The pose type is either exact (planar two
degrees of freedom, standard and forward none) or, with `level_sigma_rad`, a Gaussian prior on the deviations from it: a
spirit level that holds to 0.2 degrees is neither ignored nor believed exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rigkit.arrays import FloatArray, IntArray
from rigkit.errors import DegenerateError, InputError
from rigkit.fundamental.one_plane import one_plane_poses
from rigkit.fundamental.pose import choose_pose, essential_from_pose, translation_basis
from rigkit.fundamental.registry import fundamental_for
from rigkit.fundamental.residuals import affinity_terms, level_terms, point_terms
from rigkit.fundamental.weights import RowWeights, WeightRule, estimate_sigma_A, usable_affinities
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, rotation_angle, unit
from rigkit.geometry.sampson import sampson_distances
from rigkit.matches import Matches
from rigkit.posetype import PoseType

__all__ = ["RefinedPose", "cauchy_weights", "estimate_pose", "project_to_type", "refine_pose"]

MAX_ITERATIONS = 60
STEP_TOLERANCE = 1e-10
SAME_POSE = 5e-3
"""Two minima nearer than this (rad, and share of the baseline) mislead nobody."""
SIGNIFICANT_COST = 9.0
"""A cost (chi square) higher by this rules a pose out: three standard deviations."""
CAUCHY_SCALE = 2.385
"""In standard deviations: 95 % efficient for Gaussian noise."""


@dataclass(frozen=True, eq=False, slots=True)
class RefinedPose:
    """A refined relative pose.

    Attributes
    ----------
    cam2_from_cam1 : pose with |translation| = 1.
    covariance : (6, 6) of (left rotation perturbation rad, translation); rank five, and less under a constraint. It
        follows from the sigmas of the matches; multiply it by `variance_factor` where those are not trusted.
    sampson_rms_px : root mean square of the Sampson distances of all points.
    cost : sum of squared residuals in sigmas, with the prior's.
    variance_factor : cost of the data over the number of residuals less degrees of freedom; 1 if the sigmas are right.
    weights : (N,) factors of the squared residuals in the last iteration; 1 unless robust.
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


RobustWeights = Callable[[FloatArray], FloatArray]
"""From residuals in sigmas (N,) to factors of their squares (N,)."""


def cauchy_weights(residuals: FloatArray) -> FloatArray:
    """Return the weights 1 / (1 + (r / c)^2) of the Cauchy loss."""
    return np.asarray(1.0 / (1.0 + (residuals / CAUCHY_SCALE) ** 2))


def refine_pose(
    matches: Matches,
    start: Rigid3,
    pose_type: PoseType | str = PoseType.GENERAL,
    level_sigma_rad: float | None = None,
    *,
    covariance_A: FloatArray | None = None,
    robust: RobustWeights | None = None,
    point_weights: FloatArray | None = None,
) -> RefinedPose:
    """Return the pose of maximum likelihood near `start`.

    Parameters
    ----------
    matches : affinities take part where they have a sigma_A (or `covariance_A`): leave it out for affinities that were
        computed from the epipolar geometry or from the very same corners.
    start : its translation's length does not matter.
    pose_type : exact constraint, unless `level_sigma_rad` makes it a prior.
    level_sigma_rad : standard deviation of each deviation from the pose type.
    covariance_A : (N, 4, 4) covariance of the row-major entries of A21.
    robust : weight function for contaminated matches, `cauchy_weights` for example.
    point_weights : (N,) fixed factors of the squared residuals of each match.

    Raises
    ------
    InputError
        Fewer residuals than degrees of freedom; a pose type that cannot be refined ("auto").
    DegenerateError
        The start has no baseline, or the pose is not determined.
    """
    if str(pose_type) not in ("general", "planar", "standard", "forward"):
        raise InputError(
            f"pose type '{pose_type}' cannot be refined; decide on one of general, planar, standard, forward"
        )
    if level_sigma_rad is not None and not level_sigma_rad > 0.0:
        raise InputError(f"level sigma must be positive, got {level_sigma_rad} rad; leave it out for an exact level")
    exact = level_sigma_rad is None
    problem = _Problem(matches, str(pose_type), level_sigma_rad, covariance_A, robust, point_weights)
    R, t = project_to_type(start, pose_type) if exact else _split(start)
    return _minimise(problem, R, t)


def estimate_pose(
    matches: Matches,
    pose_type: PoseType | str = PoseType.GENERAL,
    level_sigma_rad: float | None = None,
    *,
    weights: WeightRule | RowWeights | None = None,
    robust: RobustWeights | None = None,
) -> RefinedPose:
    """Return the refined pose from scratch: linear solution, cheirality, maximum likelihood.

    With a soft level the minimisation starts from the exact pose type and from the general solution, and the better
    end is kept. With the rule "auto" sigma_A is estimated from the data and set in the matches.
    """
    if str(pose_type) == PoseType.GENERAL:
        level_sigma_rad = None
    kinds = [str(pose_type)] if level_sigma_rad is None else [str(pose_type), "general"]
    starts: list[tuple[Rigid3, Matches]] = []
    failure: DegenerateError | InputError | None = None
    for kind in kinds:
        try:
            estimate = fundamental_for(kind).solve(matches, weights)
            start = choose_pose(estimate.E21, matches.rays1, matches.rays2, kind)
            starts.append((start, _with_sigma(matches, estimate.E21, weights)))
        except (DegenerateError, InputError) as error:
            failure = failure or error
    flat = one_plane_poses(matches) if "general" in kinds else ()
    starts += [(pose, _with_sigma(matches, essential_from_pose(pose), weights)) for pose in flat]
    ends: list[RefinedPose] = []
    for start, usable in starts:
        try:
            ends.append(refine_pose(usable, start, pose_type, level_sigma_rad, robust=robust))
        except DegenerateError as error:
            failure = failure or error
    if not ends:
        raise failure or DegenerateError("no pose found")
    best = min(ends, key=lambda end: end.cost)
    if flat:
        _refuse_ambiguity(best, ends)
    return best


def _refuse_ambiguity(best: RefinedPose, ends: list[RefinedPose]) -> None:
    """Raise DegenerateError if another pose explains the points of one plane as well as the best one."""
    scale = max(best.variance_factor, 1.0)
    for end in ends:
        difference = best.cam2_from_cam1 @ end.cam2_from_cam1.inverse()
        turn, shift = float(rotation_angle(difference.rotation)), float(np.linalg.norm(difference.translation_mm))
        same = max(turn, shift) < SAME_POSE
        if not same and end.cost - best.cost < SIGNIFICANT_COST * scale:
            raise DegenerateError(
                f"all {len(best.weights)} points lie on one plane and two poses {np.degrees(turn):.1f} deg apart "
                "explain them equally well; add a board that is not parallel to it, or declare the pose type"
            )


def project_to_type(pose: Rigid3, pose_type: PoseType | str) -> tuple[FloatArray, FloatArray]:
    """Return rotation (3, 3) and unit translation (3,) of the pose of that type nearest to `pose`."""
    R, t = _split(pose)
    kind = str(pose_type)
    if kind == PoseType.PLANAR:
        angle = np.arctan2(R[0, 2] - R[2, 0], R[0, 0] + R[2, 2])
        R, t = exp_so3(np.array([0.0, angle, 0.0])), np.array([t[0], 0.0, t[2]])
    elif kind in (PoseType.STANDARD, PoseType.FORWARD):
        keep = 0 if kind == PoseType.STANDARD else 2
        R, t = np.eye(3), np.where(np.arange(3) == keep, t, 0.0)
    if not np.linalg.norm(t) > 1e-6:
        raise DegenerateError(f"the start of the refinement has no translation that pose type '{kind}' allows")
    return R, unit(t)


def _split(pose: Rigid3) -> tuple[FloatArray, FloatArray]:
    if not np.linalg.norm(pose.translation_mm) > 0.0:
        raise DegenerateError("the start of the refinement has no baseline")
    return np.array(pose.rotation), unit(pose.translation_mm)


def _with_sigma(matches: Matches, E21: FloatArray, weights: WeightRule | RowWeights | None) -> Matches:
    """Return the matches with the sigma_A that the weight rule stands for."""
    if weights == "points" or (weights == "auto" and not usable_affinities(matches).any()):
        return replace(matches, A21=None, sigma_A=None)
    if weights == "auto":
        return replace(matches, sigma_A=np.full(len(matches), max(estimate_sigma_A(matches, E21), 1e-6)))
    return matches


@dataclass(frozen=True, eq=False, slots=True)
class _Problem:
    """Residuals, Jacobian and free directions at a pose."""

    matches: Matches
    kind: str
    level_sigma_rad: float | None
    covariance_A: FloatArray | None
    robust: RobustWeights | None
    point_weights: FloatArray | None

    def free(self) -> FloatArray:
        """Return the directions (5, K) in which the pose may move: by (w, b), the first of b horizontal."""
        if self.level_sigma_rad is not None or self.kind == PoseType.GENERAL:
            return np.eye(5)
        return np.eye(5)[:, [1, 3]] if self.kind == PoseType.PLANAR else np.zeros((5, 0))

    def residuals(self, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return residuals (M,), Jacobian (M, 5) and the match of each (M,), -1 for the prior; no weights yet."""
        basis = translation_basis(t)
        r, jacobian = point_terms(self.matches, R, t, basis)
        ra, ja, which = affinity_terms(self.matches, R, t, basis, self.covariance_A)
        rows, by, of = [r, ra.reshape(-1)], [jacobian, ja.reshape(-1, 5)], [np.arange(len(r)), np.repeat(which, 2)]
        if self.level_sigma_rad is not None:
            deviation, by_pose = level_terms(self.kind, R, t, basis)
            rows.append(deviation / self.level_sigma_rad)
            by.append(by_pose / self.level_sigma_rad)
            of.append(np.full(len(deviation), -1))
        return np.concatenate(rows), np.concatenate(by), np.concatenate(of)

    def weights(self, r: FloatArray, of: IntArray) -> FloatArray:
        """Return the factors (M,) of the squared residuals."""
        n = len(self.matches)
        w = np.ones(n) if self.point_weights is None else np.asarray(self.point_weights, dtype=np.float64)
        data = of >= 0
        out = np.where(data, w[np.maximum(of, 0)], 1.0)
        if self.robust is not None:
            # A match is doubted by its point and by its affinity, each per degree of freedom.
            doubt = self.robust(r[:n])
            pair = r[n : n + 2 * int((data.sum() - n) // 2)].reshape(-1, 2)
            of_pair = self.robust(np.sqrt(0.5 * np.sum(pair**2, axis=1)))
            out[:n] *= doubt
            out[n : n + pair.size] *= np.repeat(of_pair, 2) * doubt[of[n : n + pair.size]]
        return out


def _minimise(problem: _Problem, R: FloatArray, t: FloatArray) -> RefinedPose:
    free = problem.free()
    freedom = free.shape[1]
    r, jacobian, of = problem.residuals(R, t)
    if len(r) < freedom:
        raise InputError(f"pose refinement: {len(r)} residuals for {freedom} degrees of freedom; add matches")
    w = problem.weights(r, of)
    damping, converged, iterations = 1e-6, freedom == 0, 0
    while not converged and iterations < MAX_ITERATIONS:
        iterations += 1
        J = jacobian @ free
        gram, gradient = (J.T * w) @ J, (J.T * w) @ r
        scale = np.diag(gram) + 1e-12 * np.trace(gram) + 1e-300
        step = np.linalg.solve(gram + damping * np.diag(scale), -gradient)
        new_R, new_t = _moved(R, t, free @ step)
        new_r, new_jacobian, _ = problem.residuals(new_R, new_t)
        converged = bool(np.abs(step).max() < STEP_TOLERANCE)
        # Both poses under the old weights: a step that lowers this sum lowers the robust loss as well.
        if np.sum(w * new_r**2) <= np.sum(w * r**2) * (1.0 + 1e-14):
            R, t, r, jacobian = new_R, new_t, new_r, new_jacobian
            w = problem.weights(r, of)
            damping = max(damping * 0.1, 1e-12)
        else:
            converged = converged or damping > 1e8
            damping *= 10.0
    root = np.sqrt(w)
    return _result(problem, R, t, r * root, (jacobian @ free) * root[:, None], w[of >= 0], iterations, converged)


def _moved(R: FloatArray, t: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    return exp_so3(step[:3]) @ R, unit(t + step[3:] @ translation_basis(t))


def _result(
    problem: _Problem,
    R: FloatArray,
    t: FloatArray,
    r: FloatArray,
    J: FloatArray,
    w: FloatArray,
    iterations: int,
    converged: bool,
) -> RefinedPose:
    matches, freedom = problem.matches, J.shape[1]
    gram = J.T @ J
    if freedom and np.linalg.eigvalsh(gram)[0] <= 1e-14 * np.trace(gram):
        raise DegenerateError(
            "the matches do not determine the pose (all on one plane in a critical position, or no baseline); "
            "add points off that plane or declare the pose type"
        )
    to_six = np.zeros((6, 5))
    to_six[:3, :3] = np.eye(3)
    to_six[3:, 3:] = translation_basis(t).T
    spread = to_six @ problem.free()
    covariance = spread @ np.linalg.inv(gram) @ spread.T if freedom else np.zeros((6, 6))
    prior = 0
    if problem.level_sigma_rad is not None:
        prior = len(level_terms(problem.kind, R, t, translation_basis(t))[0])
    data, n = r[: len(r) - prior], len(matches)
    pose = Rigid3(R, t)
    E21 = essential_from_pose(pose)
    px = sampson_distances(E21, matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2)
    return RefinedPose(
        pose,
        covariance,
        float(np.sqrt(np.mean(px**2))),
        float(r @ r),
        float(data @ data) / max(len(data) + prior - freedom, 1),
        w[:n],
        iterations,
        converged,
    )
