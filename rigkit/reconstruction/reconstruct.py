"""From matched corners of a pair to an oriented cloud in millimetres: the pose-type-aware pipeline.

Points give the epipolar geometry; directions (and, for F2UDIR and F3UDIR, that geometry) give an affinity at every
corner; points and affinities give the epipolar geometry again, with the solver of the pair's pose type; maximum
likelihood refines the pose; rays are intersected optimally, affinities give normals, the squares give the scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.affinities import Affinities, EpipolarNormals
from rigkit.affine.geometry_noise import geometry_covariance
from rigkit.affine.normal import estimate_normals
from rigkit.affine.registry import affines_from_directions, needs_epipolar
from rigkit.cameras.base import Camera
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Mat3, Pixels, in_8_bits
from rigkit.core.boards import Board
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.metric import MetricPose, metric_pose, triangulate_matches
from rigkit.relative_pose.refinement.refine import RefinedPose, refine_pose, rules_out
from rigkit.relative_pose.refinement.select import DEFAULT_LEVEL_RAD, pose_type_evidence
from rigkit.relative_pose.solvers.pose import choose_pose, essential_from_pose
from rigkit.relative_pose.solvers.registry import fundamental_for
from rigkit.relative_pose.solvers.weights import WeightRule

if TYPE_CHECKING:
    from rigkit.reconstruction.pairing import MatchedPair

__all__ = ["Reconstruction", "decide_pose_type", "oriented_cloud", "reconstruct_pair"]

MAX_BASELINE_SIGMA = 0.2
"""A baseline known to no better than a fifth of itself is no baseline: whatever is built on it is noise."""

NOTABLE_SCATTER = 2.0
"""Corners that scatter this many times more than predicted are worth a word: blur, JPEG, a bad calibration."""

SAME_COST = 1e-9
"""Costs that differ by less than this part are one minimum, reached from two sides."""

GREY = 160


@dataclass(frozen=True, eq=False, slots=True)
class Reconstruction:
    """What the pipeline found for one pair with one affine estimator.

    Attributes
    ----------
    pair_id : name of the pair.
    pose_type : the pose type used (never AUTO).
    affine_method : "F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR" or "3SDIR".
    camera1, camera2 : the calibrated cameras of the two images.
    boards : the boards reconstructed, in the order of `matches.board_index`.
    matches : points and affinities in the coordinates that the pipeline worked in (rectified views or raw pixels).
    pixels1, pixels2 : (N, 2) the same corners in the two images as captured.
    cam2_from_cam1 : relative pose, metric.
    pose_covariance : (6, 6) of (left rotation perturbation rad, translation mm), or None.
    E21 : (3, 3) essential matrix, unit Frobenius norm.
    cloud : points and normals in the frame of camera 1; row n belongs to match n.
    baseline_mm, baseline_sigma_mm : length of the translation and its predicted standard deviation.
    sampson_rms_px : rms Sampson distance of the corners from the epipolar geometry.
    notes : what was dropped, assumed or contradicted, in words.
    level_sigma_rad : how well the pose type was taken to hold in the refinement; None: exactly, or it is general.
    """

    pair_id: str
    pose_type: PoseType
    affine_method: str
    camera1: Camera
    camera2: Camera
    boards: tuple[Board, ...]
    matches: Matches
    pixels1: Pixels
    pixels2: Pixels
    cam2_from_cam1: Rigid3
    pose_covariance: FloatArray | None
    E21: Mat3
    cloud: OrientedCloud
    baseline_mm: float
    baseline_sigma_mm: float
    sampson_rms_px: float
    notes: tuple[str, ...] = ()
    level_sigma_rad: float | None = None


def reconstruct_pair(
    pair: MatchedPair,
    *,
    pose_type: PoseType | str,
    affine_method: str = "3SDIR",
    level_sigma_rad: float | None = None,
    scale: str = "area",
    image1: NDArray[np.generic] | None = None,
) -> Reconstruction:
    """Reconstruct one pair with one affine estimator.

    Parameters
    ----------
    pair : matched corners and directions, from `match_pair`.
    pose_type : as a person declared it; AUTO takes the type that the data support best. A declared type that the data
        contradict is used as told, and `notes` gives the figure.
    affine_method : see `rigkit.affine.registry.AFFINE_METHODS`.
    level_sigma_rad : how well the spirit level held: the pose type is a soft prior in the refinement. None: as well as
        a carefully set level does (DEFAULT_LEVEL_RAD); 0: the pose type is exact.
    scale : of DET3UDIR, see `affines_from_directions`.
    image1 : image of camera 1, (H, W) or (H, W, 3) RGB, uint8 or uint16: colours of the cloud.

    Raises
    ------
    DegenerateError
        No baseline, or geometry that does not determine the pose.

    Notes
    -----
    On a chessboard the affinities come from the very corners that are the points: they take part in the linear
    solution, as in the paper, but the likelihood counts every corner once.
    """
    try:
        return _reconstruct(pair, PoseType(pose_type), affine_method, level_sigma_rad, scale, image1)
    except DegenerateError as error:
        words = f"pair '{pair.pair_id}': {error}"
        raise DegenerateError(
            "; ".join((words, *_contradiction(pair, PoseType(pose_type), level_sigma_rad)))
        ) from error


def _reconstruct(
    pair: MatchedPair,
    pose_type: PoseType,
    affine_method: str,
    level_sigma_rad: float | None,
    scale: str,
    image1: NDArray[np.generic] | None,
) -> Reconstruction:
    known = _known_by_points(pair, pose_type, level_sigma_rad)
    pose_type, level_sigma_rad = known.pose_type, known.level_sigma_rad
    affinities = _affinities(pair, affine_method, known.E21, scale)
    matches = pair.matches.with_affinities(affinities.A21, affinities.sigma_A)
    # Affinities computed from an epipolar geometry satisfy it exactly: estimating it from them again is circular.
    rule: WeightRule = "points" if needs_epipolar(affine_method) else "noise"
    pair, refined, metric, remarks = _metric(pair, _likeliest_pose(pair, matches, rule, known), known)
    notes = [*pair.notes, *known.remarks, *remarks]
    E21 = essential_from_pose(metric.cam2_from_cam1)
    affinities = _affinities(pair, affine_method, E21, scale)
    matches = pair.matches.with_affinities(affinities.A21, affinities.sigma_A)
    affines: Callable[[EpipolarNormals], Affines] | None = None
    if needs_epipolar(affine_method):

        def affines(epipolar: EpipolarNormals) -> Affines:
            return affines_from_directions(pair.directions, affine_method, epipolar=epipolar).A21

    cloud, kept = oriented_cloud(
        pair.captured,
        pair.matches,
        metric.cam2_from_cam1,
        metric.covariance,
        affinities,
        affines=affines,
        image1=image1,
        board_ids=tuple(board.board_id for board in pair.boards),
    )
    if not kept.all():
        lost = int((~kept).sum())
        notes.append(f"{lost} of {len(kept)} corners have no {affine_method} normal or point and were left out")
    return Reconstruction(
        pair.pair_id,
        pose_type,
        affine_method,
        pair.camera1,
        pair.camera2,
        pair.boards,
        matches.select(kept),
        pair.captured.pixels1[kept],
        pair.captured.pixels2[kept],
        metric.cam2_from_cam1,
        metric.covariance,
        E21,
        cloud,
        metric.baseline_mm,
        metric.baseline_sigma_mm,
        refined.sampson_rms_px,
        tuple(notes),
        level_sigma_rad,
    )


def _contradiction(pair: MatchedPair, declared: PoseType, level_sigma_rad: float | None) -> tuple[str, ...]:
    """Return what speaks against the declared pose type: the likeliest reason of a pose that makes no sense."""
    if declared is PoseType.AUTO:
        return ()
    try:
        return decide_pose_type(pair.captured, declared, level_sigma_rad)[2]
    except DegenerateError:
        return ()


@lru_cache(maxsize=4)
def decide_pose_type(
    captured: Matches, declared: PoseType, level_sigma_rad: float | None
) -> tuple[PoseType, float | None, tuple[str, ...]]:
    """Return the pose type to use, the level's sigma (None: exact, or nothing to hold), and what there is to say.

    Remembered for the matches last asked about: the answer is the same for every affine estimator of a pair.
    """
    if declared is PoseType.GENERAL:
        return declared, None, ()
    level = DEFAULT_LEVEL_RAD if level_sigma_rad is None else level_sigma_rad
    evidence = pose_type_evidence(captured, level or None)
    if declared is PoseType.AUTO:
        chosen = evidence.types[0]
        words = f"pose type '{chosen.pose_type}' chosen (probability {chosen.probability:.3f})"
        # The evidence is for the type up to a level's accuracy, not for an exact one that nobody declared.
        soft = None if chosen.pose_type is PoseType.GENERAL else evidence.level_sigma_rad
        return chosen.pose_type, soft, (words,)
    contradiction = evidence.contradiction(declared)
    return declared, level or None, () if contradiction is None else (contradiction,)


@dataclass(frozen=True, eq=False, slots=True)
class _Known:
    """What the points of a pair say without any affinity.

    Attributes
    ----------
    E21 : (3, 3) linear solution.
    pose_type, level_sigma_rad, remarks : see `decide_pose_type`.
    told, linear : ends of the refinement from the pose by which the boards were told apart and from the linear
        solution, None where the start leads nowhere.
    failure : why a start leads nowhere.
    """

    E21: Mat3
    pose_type: PoseType
    level_sigma_rad: float | None
    remarks: tuple[str, ...]
    told: RefinedPose | None
    linear: RefinedPose | None
    failure: DegenerateError | None


@lru_cache(maxsize=4)
def _known_by_points(pair: MatchedPair, pose_type: PoseType, level_sigma_rad: float | None) -> _Known:
    """Remembered, as in `decide_pose_type`: the answer is the same for every affine estimator."""
    m = pair.matches
    try:
        E21 = fundamental_for(PoseType.GENERAL).solve(m).E21
    except DegenerateError:
        # One board leaves it open; the pose by which the boards were told apart knows the board's shape.
        E21 = essential_from_pose(pair.identity.cam2_from_cam1)
    pose_type, level_sigma_rad, remarks = decide_pose_type(pair.captured, pose_type, level_sigma_rad)
    told, failure = _end(pair, lambda: pair.identity.cam2_from_cam1, pose_type, level_sigma_rad)
    linear, other = _end(pair, lambda: choose_pose(E21, m.rays1, m.rays2), pose_type, level_sigma_rad)
    return _Known(E21, pose_type, level_sigma_rad, remarks, told, linear, failure or other)


def _end(
    pair: MatchedPair, start: Callable[[], Rigid3], pose_type: PoseType, level_sigma_rad: float | None
) -> tuple[RefinedPose | None, DegenerateError | None]:
    """Return the end of the refinement from a start, or why there is none."""
    try:
        return refine_pose(pair.captured, start(), pose_type, level_sigma_rad), None
    except DegenerateError as error:
        return None, error


def _likeliest_pose(pair: MatchedPair, matches: Matches, rule: WeightRule, known: _Known) -> RefinedPose:
    """Return the pose of maximum likelihood among the ends of the refinement from every start there is.

    The linear solution of a pose type holds it exactly: where a level is off by half a degree and the corners are good,
    it can land in another valley. The general solution and the pose by which the boards were told apart cannot. Points
    of one plane are explained by two poses: that of the board, whose shape is known, stands unless they rule it out.
    """

    def of_type() -> Rigid3:
        estimate = fundamental_for(known.pose_type).solve(matches, rule)
        return choose_pose(estimate.E21, matches.rays1, matches.rays2, known.pose_type)

    typed, failure = _end(pair, of_type, known.pose_type, known.level_sigma_rad)
    ends = [end for end in (known.told, known.linear, typed) if end is not None]
    if not ends:
        raise failure or known.failure or DegenerateError("no pose found")
    best = min(ends, key=lambda end: end.cost)
    if known.told is not None and not rules_out(pair.captured, best, known.told):
        return known.told
    # In one valley all starts end alike, and estimators that do share what follows.
    return next(end for end in ends if end.cost <= best.cost * (1.0 + SAME_COST))


@lru_cache(maxsize=4)
def _metric(
    pair: MatchedPair, refined: RefinedPose, known: _Known
) -> tuple[MatchedPair, RefinedPose, MetricPose, tuple[str, ...]]:
    """Return the pair with sigmas that fit what is seen, its pose, the pose in mm, and what there is to say of it."""
    notes: tuple[str, ...] = ()
    scatter = float(np.sqrt(refined.variance_factor))
    if scatter > 1.0:
        # The corners miss the epipolar geometry by more than their sigmas promise: believe what is seen.
        pair = pair.noisier(scatter)
        refined = refine_pose(pair.captured, refined.cam2_from_cam1, known.pose_type, known.level_sigma_rad)
    if scatter > NOTABLE_SCATTER:
        notes = (f"corners scatter {scatter:.1f} times as much as predicted; all sigmas were enlarged to match",)
    metric = metric_pose(pair.captured, refined.cam2_from_cam1, refined.covariance, pair.boards)
    if metric.baseline_sigma_mm > MAX_BASELINE_SIGMA * metric.baseline_mm:
        raise DegenerateError(
            f"the baseline is {metric.baseline_mm:.2f} mm, known to no better than {metric.baseline_sigma_mm:.2f} mm: "
            "too short for these boards; move the camera further between the images"
        )
    return pair, refined, metric, notes


def _affinities(pair: MatchedPair, method: str, E21: Mat3, scale: str) -> Affinities:
    m = pair.matches
    epipolar = None
    if needs_epipolar(method):
        epipolar = EpipolarNormals.from_rays(m.rays1, m.jacobians1, m.rays2, m.jacobians2, E21)
    return affines_from_directions(pair.directions, method, epipolar=epipolar, scale=scale, noise=pair.noise)


def oriented_cloud(
    captured: Matches,
    matches: Matches,
    cam2_from_cam1: Rigid3,
    pose_covariance: FloatArray,
    affinities: Affinities,
    *,
    affines: Callable[[EpipolarNormals], Affines] | None = None,
    image1: NDArray[np.generic] | None = None,
    board_ids: tuple[str, ...] = (),
) -> tuple[OrientedCloud, BoolArray]:
    """Return the oriented cloud, and which (N,) of the matches are in it: those with a point and a normal.

    Parameters
    ----------
    captured : the points in captured pixels; they are triangulated.
    matches : the same points in the coordinates of the affinities.
    cam2_from_cam1, pose_covariance : the cloud has the unit of its translation.
    affinities : of the points.
    affines : affinities for an epipolar geometry, where they follow from it and so move with it.
    image1 : colours.

    Raises
    ------
    DegenerateError
        No match has both a point and a normal.
    """
    points, covariance, seen = triangulate_matches(captured, cam2_from_cam1, pose_covariance)
    m = matches
    J1, J2 = pair_projection_jacobians(points, m.rays1, m.jacobians1, m.rays2, m.jacobians2, cam2_from_cam1)
    geometry = geometry_covariance(
        m.rays1,
        m.jacobians1,
        m.rays2,
        m.jacobians2,
        cam2_from_cam1,
        affines if affines is not None else affinities.A21,
        sigma1_px=m.sigma1_px,
        sigma2_px=m.sigma2_px,
        pose_covariance=pose_covariance,
    )
    normals = estimate_normals(J1, J2, affinities.A21, covariance=affinities.covariance, geometry=geometry)
    kept = seen & normals.valid & np.isfinite(covariance).all(axis=(1, 2))
    if not kept.any():
        raise DegenerateError("no match has both a point and a normal; check affinities and baseline")
    cloud = OrientedCloud(
        points[kept],
        normals.normals[kept],
        _colours(image1, captured.pixels1[kept]),
        m.board_index[kept],
        m.grid[kept],
        np.sqrt(np.linalg.eigvalsh(covariance[kept])[:, -1]),
        normals.sigma_rad[kept],
        board_ids,
    )
    return cloud, kept


def _colours(image: NDArray[np.generic] | None, pixels: Pixels) -> NDArray[np.uint8]:
    """Return the colours at the nearest pixels, (N, 3); grey where there is no image."""
    if image is None:
        return np.full((len(pixels), 3), GREY, dtype=np.uint8)
    column, row = np.rint(pixels).astype(np.int64).T
    values = in_8_bits(image)[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
    grey = values[:, None] if values.ndim == 1 else values
    return np.ascontiguousarray(np.broadcast_to(grey, (len(pixels), 3)), dtype=np.uint8)
