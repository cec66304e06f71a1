"""Reconstruct an oriented cloud from correspondences of any scene, without boards.

Correspondences of natural images contain outliers, and their stated sigmas are too small. A robust search finds the
pose with most inliers. The inliers' residuals give the noise of points and affinities, and the pose is refined by the
joint likelihood of both. Without boards, lengths are in baselines unless the baseline is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.affinities import Affinities, EpipolarNormals
from rigkit.affine.correspondences import Correspondences
from rigkit.affine.registry import affines_from_directions
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera, far_camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.core.printing import brief, drawn
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.metric import triangulate_matches
from rigkit.reconstruction.reconstruct import Reconstruction, colours_at, oriented_cloud
from rigkit.reconstruction.scene_pose import MIN_MATCHES, KnownPose, ScenePose, fit_scene_pose, known_scene_pose
from rigkit.relative_pose.refinement.select import pose_type_evidence
from rigkit.relative_pose.solvers.pose import essential_from_pose
from rigkit.relative_pose.solvers.weights import usable_affinities

MAX_RANGE_SIGMA = 0.3
"""Largest relative standard deviation of a point's distance; points beyond are left out."""
MIN_SHARE_AGREEING = 0.3
"""Inlier ratio below which a note warns. Ten REAL pairs of five scenes have 0.64 to 0.92; a RENDERED wall of one
repeated picture had 0.10, and a wrong pose."""
NO_DISTANCE = "no point has a depth better than its uncertainty; the baseline is too short for this scene"
SAME_ROW = 1e-9
"""Tangents of rows of two rectified images agree to rounding: they are computed, not measured."""
PIXELS_A_SIDE = 9
PUPIL_ROUNDS = 3
"""Pupils move by a few hundredths of the points' distance: after three rounds the error is below 0.001 px."""
RECTIFIED_NOTE = (
    "the cameras and the matches are those of a rectified pair, whose pose is exact; for one camera moved sideways by "
    "hand declare the pose type 'general'"
)


@dataclass(frozen=True, eq=False, slots=True)
class SceneReconstruction:
    """The reconstruction of one pair of views of any scene.

    Attributes
    ----------
    reconstruction : pose, matches and cloud, with no boards. Lengths are in mm, or in baselines if not `metric`.
    metric : whether the baseline was given.
    inliers : (N,) mask of the correspondences that fit the pose.
    kept : (K,) indices of the correspondences of the cloud's points.
    sigma_px : standard deviation of the inliers' points per axis, from their residuals (median).
    sigma_A : the same for an entry of their affinities; NaN if these were computed from directions and the pose.
    """

    reconstruction: Reconstruction
    metric: bool
    inliers: BoolArray
    kept: NDArray[np.int64]
    sigma_px: float
    sigma_A: float

    __repr__, _repr_html_ = brief, drawn

    @property
    def unit(self) -> str:
        """The unit of lengths: "mm", or "baselines" if the baseline was not given."""
        return "mm" if self.metric else "baselines"


def reconstruct_scene(
    correspondences: Correspondences,
    camera1: Camera,
    camera2: Camera,
    *,
    pair_id: str = "scene",
    pose_type: PoseType | str | None = None,
    level_sigma_rad: float | None = None,
    baseline_mm: float | None = None,
    known_pose: KnownPose | None = None,
    image1: NDArray[np.generic] | None = None,
    seed: int = 0,
) -> SceneReconstruction:
    """Reconstruct two views of any scene from point correspondences with affinities or directions.

    Raises InputError for too few correspondences, without affinities and directions, or for a baseline that is not
    positive; DegenerateError if too few correspondences agree with any pose, or there is no baseline.

    Parameters
    ----------
    correspondences : may contain outliers; only the ratios of their sigmas are used.
    camera1, camera2 : calibrated cameras.
    pair_id : for messages.
    pose_type, level_sigma_rad : as for `reconstruct_pair`. None: general, or standard and exact for a rectified pair.
    baseline_mm : measured length of the baseline, if known; then the cloud is in mm.
    known_pose : measured pose, if known; it is not refined, and gives the baseline.
    image1 : image of camera 1, for colours.
    seed : of the robust search.
    """
    baseline_mm = baseline_mm if known_pose is None else known_pose.baseline_mm
    matches, seen = _matches(correspondences, camera1, camera2, baseline_mm, pair_id)
    try:
        fit = _fit(matches, known_pose, pose_type, level_sigma_rad, seed, are_rectified(camera1, camera2))
        pose, covariance = in_unit(fit.refined.cam2_from_cam1, fit.refined.covariance, baseline_mm or 1.0)
        cloud, chosen, affinities = _cloud(fit, correspondences.select(seen), pose, covariance, image1)
    except DegenerateError as error:
        raise DegenerateError(f"'{pair_id}': {error}") from error
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
        cam2_from_cam1=pose,
        pose_covariance=covariance,
        E21=essential_from_pose(fit.refined.cam2_from_cam1),
        cloud=cloud,
        baseline_mm=baseline_mm or 1.0,
        baseline_sigma_mm=0.0,
        sampson_rms_px=fit.refined.sampson_rms_px,
        notes=_notes(fit, seen, baseline_mm),
        level_sigma_rad=fit.level_sigma_rad,
    )
    return _scene(reconstruction, fit, seen, chosen, metric=baseline_mm is not None)


def correct_moving_pupils(
    scene_of: Callable[[Correspondences], SceneReconstruction],
    correspondences: Correspondences,
    cameras: tuple[Camera, Camera],
) -> SceneReconstruction:
    """Return `scene_of` the correspondences, corrected for moving entrance pupils (`NearCamera`) if it is in mm.

    `scene_of` treats the lenses as central. The correction depends on the points' distances, and these on it: it is a
    fixed-point iteration, whose error shrinks by the pupil's motion over the points' distance in each round.
    """
    scene, moving = scene_of(correspondences), [isinstance(camera, NearCamera) for camera in cameras]
    if not (any(moving) and scene.metric):
        return scene
    lenses, found, largest = (far_camera(cameras[0]), far_camera(cameras[1])), correspondences, 0.0
    for _ in range(PUPIL_ROUNDS):
        pose, (matches, seen) = scene.reconstruction.cam2_from_cam1, found.matches(*lenses)
        points = np.full((len(seen), 3), np.nan)
        points[seen] = triangulate_matches(matches, pose).points
        pixels = []
        for camera, p, at in zip(
            cameras, (points, pose.apply(points)), (correspondences.pixels1, correspondences.pixels2), strict=True
        ):
            moved = camera.as_with_fixed_pupil(at, p) if isinstance(camera, NearCamera) else at
            pixels.append(np.where(np.isfinite(moved), moved, at))
        found = replace(correspondences, pixels1=pixels[0], pixels2=pixels[1])
        scene = scene_of(found)
        off = np.maximum(np.abs(pixels[0] - correspondences.pixels1), np.abs(pixels[1] - correspondences.pixels2))
        largest = float(off[scene.kept].max())
    note = f"entrance pupils move; points were corrected to central cameras, by up to {largest:.1f} px"
    r = scene.reconstruction
    return replace(scene, reconstruction=replace(r, notes=(note, *r.notes)))


def _fit(
    matches: Matches,
    known_pose: KnownPose | None,
    pose_type: PoseType | str | None,
    level_sigma_rad: float | None,
    seed: int,
    rectified: bool,
) -> ScenePose:
    if known_pose is not None:
        return known_scene_pose(matches, known_pose)
    declared = PoseType(pose_type or "general")
    fit = fit_scene_pose(matches, declared, level_sigma_rad, np.random.default_rng(seed))
    if pose_type is not None or not (rectified and support_rectified_pose(fit.matches.select(fit.inliers))):
        return fit
    exact = fit_scene_pose(fit.matches, PoseType.STANDARD, 0.0, np.random.default_rng(seed))
    return replace(exact, notes=(*exact.notes, RECTIFIED_NOTE))


def _scene(
    reconstruction: Reconstruction, fit: ScenePose, seen: BoolArray, chosen: NDArray[np.int64], *, metric: bool
) -> SceneReconstruction:
    """Return the scene: `seen` is the mask of the correspondences with matches, `chosen` the indices of the matches in
    the cloud."""
    inliers, sigma_A = np.zeros(len(seen), dtype=bool), fit.matches.sigma_A
    inliers[seen] = fit.inliers
    return SceneReconstruction(
        reconstruction,
        metric,
        inliers,
        np.flatnonzero(seen)[chosen],
        float(np.median(fit.matches.sigma1_px[fit.inliers])),
        float("nan") if sigma_A is None else float(np.median(sigma_A[fit.inliers])),
    )


def _matches(
    correspondences: Correspondences, camera1: Camera, camera2: Camera, baseline_mm: float | None, pair_id: str
) -> tuple[Matches, BoolArray]:
    """Return the matches, and a mask of the correspondences with one. Raises InputError for unusable ones."""
    if baseline_mm is not None and not (np.isfinite(baseline_mm) and baseline_mm > 0.0):
        raise InputError(f"'{pair_id}': the baseline must be positive, got {baseline_mm} mm")
    if correspondences.A21 is None and correspondences.directions is None:
        raise InputError(
            f"'{pair_id}': the correspondences have neither affinities nor directions, without which there are no "
            "normals; give the images too, or add columns a11, a12, a21, a22 or du1_1, dv1_1, ..."
        )
    matches, seen = correspondences.matches(camera1, camera2)
    if len(seen) < MIN_MATCHES:
        raise InputError(
            f"'{pair_id}': only {len(seen)} correspondences, at least {MIN_MATCHES} are needed; give images that show "
            "more of one textured scene, from places nearer to each other"
        )
    if seen.sum() < MIN_MATCHES:
        raise InputError(
            f"'{pair_id}': {int(seen.sum())} of {len(seen)} correspondences lie in both cameras' fields of view; at "
            f"least {MIN_MATCHES} are needed"
        )
    return matches, seen


def _notes(fit: ScenePose, seen: BoolArray, baseline_mm: float | None) -> tuple[str, ...]:
    notes = list(fit.notes)
    if (agree := int(fit.inliers.sum())) < MIN_SHARE_AGREEING * len(fit.inliers):
        notes.append(
            f"only {agree} of {len(fit.inliers)} correspondences agree with this pose: the scene may look the same in "
            "many places, and the pose be another, things may have moved, or a calibration be wrong; look at the cloud "
            "before you trust it"
        )
    if not seen.all():
        notes.append(f"{int((~seen).sum())} correspondences lie outside the calibrated field of view")
    if baseline_mm is None:
        notes.append("no baseline is given: lengths are in baselines, not in mm")
    return tuple(notes)


def _affinities(found: Correspondences, fit: ScenePose) -> Affinities:
    """Return the affinities of all inliers: the given ones, else those from directions and the pose.

    Those from the pose always fulfil the epipolar geometry, so only given ones have a sigma.
    """
    m, E21 = fit.matches, essential_from_pose(fit.refined.cam2_from_cam1)
    n = len(m)
    A21, covariance = np.full((n, 2, 2), np.nan), np.full((n, 4, 4), np.nan)
    if m.A21 is not None and m.sigma_A is not None:
        good = usable_affinities(m) & np.isfinite(m.sigma_A)
        A21[good] = m.A21[good]
        covariance[good] = m.sigma_A[good, None, None] ** 2 * np.eye(4)
    if found.directions is not None:
        epipolar = EpipolarNormals.of_matches(m, E21)
        computed = affines_from_directions(found.directions, "F3UDIR", epipolar=epipolar).A21
        A21 = np.where(np.isfinite(A21), A21, computed)
    A21[~fit.inliers] = np.nan
    return Affinities(A21, np.isfinite(A21).all(axis=(1, 2)), np.full(n, np.nan), covariance)


def _cloud(
    fit: ScenePose, found: Correspondences, pose: Rigid3, covariance: FloatArray, image1: NDArray[np.generic] | None
) -> tuple[OrientedCloud, NDArray[np.int64], Affinities]:
    """Return the cloud, the indices of the matches in it, and the affinities of all matches."""
    affinities = _affinities(found, fit)
    points = triangulate_matches(fit.matches, pose, covariance)
    colours = colours_at(image1, fit.matches.pixels1)
    cloud, kept = oriented_cloud(points, fit.matches, pose, covariance, affinities, colours=colours)
    sure = cloud.sigma_mm < MAX_RANGE_SIGMA * np.linalg.norm(cloud.points_mm, axis=1)
    if not sure.any():
        raise DegenerateError(NO_DISTANCE)
    return replace(cloud.select(sure), from_origin=True), np.flatnonzero(kept)[sure], affinities


def in_unit(pose: Rigid3, covariance: FloatArray, scale: float) -> tuple[Rigid3, FloatArray]:
    """Return a pose of unit baseline, and its covariance (6, 6), scaled to the baseline `scale`."""
    by = np.repeat([1.0, scale], 3)
    return Rigid3(pose.rotation, scale * pose.translation_mm), np.asarray(by[:, None] * covariance * by)


def are_rectified(camera1: Camera, camera2: Camera) -> bool:
    """Return whether both are perspective cameras of one focal length whose rows correspond.

    Their principal points may differ along the row.
    """
    if camera1.size_px[1] != camera2.size_px[1]:
        return False
    tangents = []
    for camera in (camera1, camera2):
        at = np.stack(np.meshgrid(*(np.linspace(0, n - 1, PIXELS_A_SIDE) for n in camera.size_px)), axis=-1)
        rays, seen = camera.unproject(at)
        if not (seen.all() and (rays[..., 2] > 0.0).all()):
            return False
        x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
        slope = np.diff(x, axis=1) / np.diff(at[..., 0], axis=1)
        if np.ptp(slope) > SAME_ROW or np.ptp(y, axis=1).max() > SAME_ROW:
            return False
        tangents.append(np.append(y[:, 0], slope.mean()))
    return bool(np.abs(tangents[0] - tangents[1]).max() < SAME_ROW)


def support_rectified_pose(matches: Matches) -> bool:
    """Return whether the matches support a baseline along the rows and no rotation."""
    try:
        return pose_type_evidence(matches).choice is PoseType.STANDARD
    except (InputError, DegenerateError):
        return False
