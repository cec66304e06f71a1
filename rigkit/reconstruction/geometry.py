"""Estimate pose type, pose, scale and points of a pair from its corners, once for all affine estimators.

Points give the epipolar geometry. The pose is refined by maximum likelihood under the pose type, from several initial
poses. The squares give the scale, and the points are triangulated. Affine estimators differ only in their normals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import Mat3
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.core.printing import brief
from rigkit.reconstruction.metric import MetricPose, TriangulatedPoints, metric_pose, triangulate_matches
from rigkit.reconstruction.pairing import MatchedPair
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.relative_pose.refinement.refine import POSE_FREEDOM, RefinedPose, refine_pose, rules_out, variance_factor
from rigkit.relative_pose.refinement.select import (
    DEFAULT_LEVEL_RAD,
    EXACT_LEVEL_RAD,
    PoseTypeEvidence,
    pose_type_evidence,
)
from rigkit.relative_pose.solvers.pose import choose_pose, essential_from_pose
from rigkit.relative_pose.solvers.registry import fundamental_for

MAX_BASELINE_SIGMA = 0.2
"""Largest relative standard deviation of the baseline: above, the reconstruction would be noise."""

NOTABLE_SCATTER = 2.0
"""Ratio of observed to predicted corner noise that gets a note: blur, JPEG, or a bad calibration."""

SAME_COST = 1e-9
"""Costs that differ relatively by less are of the same minimum."""


@dataclass(frozen=True, eq=False, slots=True)
class PoseTypeDecision:
    """The pose type to use, and the evidence for it.

    Attributes
    ----------
    declared : as the user declared it.
    pose_type : the type to use (never AUTO).
    level_sigma_rad : standard deviation of the pose-type prior; None: the type holds exactly, or is general.
    evidence : for every type; None if the general type was declared, which nothing contradicts.
    notes : the choice under AUTO, or what contradicts the declaration.
    level_frames : in which the type holds; None: those of the cameras.
    """

    declared: PoseType
    pose_type: PoseType
    level_sigma_rad: float | None
    evidence: PoseTypeEvidence | None
    notes: tuple[str, ...]
    level_frames: LevelFrames | None = None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PairGeometry:
    """The geometry of a pair, which does not depend on the affine estimator.

    Attributes
    ----------
    pair : the matched corners, with sigmas scaled to the residuals.
    decision : the pose type, and the evidence for it.
    refined : pose of maximum likelihood, unit baseline.
    metric : the pose in mm, with its covariance.
    E21 : (3, 3) essential matrix of that pose, unit Frobenius norm.
    points : the triangulated corners, mm, in the frame of camera 1.
    scatter : ratio of observed to stated corner noise; the sigmas of `pair` were multiplied by it.
    notes : warnings: what was left out, assumed or contradicted.
    """

    pair: MatchedPair
    decision: PoseTypeDecision
    refined: RefinedPose
    metric: MetricPose
    E21: Mat3
    points: TriangulatedPoints
    scatter: float
    notes: tuple[str, ...]

    __repr__ = brief

    @property
    def pose_type(self) -> PoseType:
        """The pose type used (never AUTO)."""
        return self.decision.pose_type


def pair_geometry(
    pair: MatchedPair,
    *,
    pose_type: PoseType | str,
    level_sigma_rad: float | None = None,
    level_frames: LevelFrames | None = None,
) -> PairGeometry:
    """Return pose, scale and points of one pair.

    Raises InputError for level frames with another motion than planar; DegenerateError if there is no baseline, or the
    corners do not determine the pose.

    Parameters
    ----------
    pair : matched corners, from `match_pair`.
    pose_type : as declared; AUTO chooses the type that the data support best. A declared type is used even if the data
        contradict it; then `notes` says so.
    level_sigma_rad : standard deviation of the pose-type prior in the refinement. None: that of a carefully set spirit
        level (DEFAULT_LEVEL_RAD); 0: the pose type is exact, unless the data contradict that.
    level_frames : for cameras that are not level themselves but whose mounting is known; planar motion only.
    """
    declared = PoseType(pose_type)
    if level_frames is not None and declared is not PoseType.PLANAR:
        raise InputError(f"pair '{pair.pair_id}': the level of each camera is for planar motion, not '{declared}'")
    contradiction: tuple[str, ...] = ()
    try:
        captured = pair.captured if level_frames is None else level_frames.matches(pair.captured)
        decision = replace(decide_pose_type(captured, declared, level_sigma_rad), level_frames=level_frames)
        contradiction = () if declared is PoseType.AUTO else decision.notes
        if contradiction and decision.level_sigma_rad is None:
            # Held exactly it would bend the boards, and hide that this declaration is wrong.
            instead = (
                f"{'; '.join(contradiction)}; the type is held to {np.degrees(DEFAULT_LEVEL_RAD):.2f} deg instead of "
                "exactly (errors of the calibrations, which may explain it, count only in the checks of validate)"
            )
            decision = replace(decision, level_sigma_rad=DEFAULT_LEVEL_RAD, notes=(instead,))
        return _in_mm(pair, decision, _maximum_likelihood_pose(pair, decision))
    except DegenerateError as error:
        # A wrong declaration is the likeliest reason of a degenerate pose.
        raise DegenerateError("; ".join((f"pair '{pair.pair_id}': {error}", *contradiction))) from error


def decide_pose_type(captured: Matches, declared: PoseType, level_sigma_rad: float | None) -> PoseTypeDecision:
    """Return the pose type to use for the matches, in captured pixels; see `pair_geometry`."""
    if declared is PoseType.GENERAL:
        return PoseTypeDecision(declared, declared, None, None, ())
    level = DEFAULT_LEVEL_RAD if level_sigma_rad is None else level_sigma_rad
    # The choice of a type is by a level's accuracy, not by that of an exact type.
    tested = level or (DEFAULT_LEVEL_RAD if declared is PoseType.AUTO else EXACT_LEVEL_RAD)
    evidence = pose_type_evidence(captured, tested)
    if declared is PoseType.AUTO:
        chosen = evidence.types[0]
        words = f"pose type '{chosen.pose_type}' chosen (probability {chosen.probability:.3f})"
        soft = None if chosen.pose_type is PoseType.GENERAL else tested
        return PoseTypeDecision(declared, chosen.pose_type, soft, evidence, (words,))
    contradiction = evidence.contradiction(declared)
    notes = () if contradiction is None else (contradiction,)
    return PoseTypeDecision(declared, declared, level or None, evidence, notes)


def _maximum_likelihood_pose(pair: MatchedPair, decision: PoseTypeDecision) -> RefinedPose:
    """Return the pose of maximum likelihood among the minima that the refinement reaches from several initial poses.

    The linear solution holds the pose type exactly. If a level is off by half a degree and the corners are good, it
    can lead to a wrong local minimum. The general solution and the pose that identified the boards do not. Coplanar
    points have two poses: the one from the known board shape is kept unless the points rule it out.
    """
    kind, level, frames = decision.pose_type, decision.level_sigma_rad, decision.level_frames
    m = pair.matches if frames is None else frames.matches(pair.matches)

    def end(solver: PoseType | None) -> RefinedPose | DegenerateError:
        try:
            start = pair.identity.cam2_from_cam1
            if solver is not None:
                start = choose_pose(fundamental_for(solver).solve(m, "points").E21, m.rays1, m.rays2, solver)
                start = start if frames is None else frames.camera_pose(start)
            return refine_pose(pair.captured, start, kind, level, level_frames=frames)
        except DegenerateError as error:
            return error

    identified = end(None)
    found = [identified, *(end(solver) for solver in dict.fromkeys((PoseType.GENERAL, kind)))]
    ends = [one for one in found if isinstance(one, RefinedPose)]
    if not ends:
        raise next(failure for failure in reversed(found) if isinstance(failure, DegenerateError))
    best = min(ends, key=lambda one: one.cost)
    if isinstance(identified, RefinedPose) and not rules_out(pair.captured, best, identified):
        return identified
    return next(one for one in ends if one.cost <= best.cost * (1.0 + SAME_COST))


def _in_mm(pair: MatchedPair, decision: PoseTypeDecision, refined: RefinedPose) -> PairGeometry:
    """Return the geometry of a pair in mm, with sigmas scaled to the residuals."""
    notes = [*pair.notes, *decision.notes]
    freedom = len(pair.captured) - POSE_FREEDOM
    scatter = float(np.sqrt(variance_factor(refined.variance_factor * freedom, freedom)))
    pair = pair.with_scaled_sigmas(scatter)
    level, frames = decision.level_sigma_rad, decision.level_frames
    refined = refine_pose(pair.captured, refined.cam2_from_cam1, decision.pose_type, level, level_frames=frames)
    if scatter > NOTABLE_SCATTER:
        notes.append(f"corners scatter {scatter:.1f} times as much as predicted; all sigmas were enlarged to match")
    metric = metric_pose(pair.captured, refined.cam2_from_cam1, refined.covariance, pair.boards)
    if metric.baseline_sigma_mm > MAX_BASELINE_SIGMA * metric.baseline_mm:
        raise DegenerateError(
            f"the baseline is {metric.baseline_mm:.2f} mm, known to no better than {metric.baseline_sigma_mm:.2f} mm: "
            "too short for these boards; move the camera further between the images"
        )
    return PairGeometry(
        pair=pair,
        decision=decision,
        refined=refined,
        metric=metric,
        E21=essential_from_pose(metric.cam2_from_cam1),
        points=triangulate_matches(pair.captured, metric.cam2_from_cam1, metric.covariance),
        scatter=scatter,
        notes=tuple(notes),
    )
