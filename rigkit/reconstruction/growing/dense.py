"""Reconstruct a dense oriented cloud from two images and seed matches.

Pairs are grown, the pose is estimated from them, pairs are grown again along its epipolar lines, and local planes are
fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import grey_of
from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import PosedPair
from rigkit.core.arrays import FloatArray
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, rotation_angle, unit
from rigkit.geometry.sampson import sampson_of_matches
from rigkit.optim.robust_scale import robust_sigma
from rigkit.reconstruction.growing.fill import at_best_depth, fill_holes
from rigkit.reconstruction.growing.grow import (
    EpipolarConstraint,
    GrowingView,
    GrownPatches,
    PosedViews,
    grow,
    grow_in_both_directions,
)
from rigkit.reconstruction.growing.surface import WINDOW_AREA_PX, GrownSurface, PairRays, correct_curvature, fit_surface
from rigkit.reconstruction.growing.sweep import fill_by_sweep
from rigkit.reconstruction.growing.systematic import SystematicPose, pose_with_lens_errors
from rigkit.reconstruction.moved_cameras import Calibrations, moved_pairs, visible_in_all
from rigkit.reconstruction.reconstruct import Reconstruction, colours_at
from rigkit.reconstruction.scene import MAX_RANGE_SIGMA, NO_DISTANCE, SceneReconstruction, in_unit
from rigkit.reconstruction.scene_pose import GATE, KnownPose, fit_scene_pose, known_scene_pose
from rigkit.relative_pose.refinement.residuals import point_terms
from rigkit.relative_pose.solvers.pose import essential_from_pose, pose_directions, translation_basis
from rigkit.relative_pose.solvers.weights import estimate_sigma_A

POSE_STEP = 8
"""Node spacing, px, of the pairs for the pose: evenly spread, unlike features."""
CLOUD_STEP = 3
CLOUD_NODES = 80_000
"""Largest number of nodes of a cloud: their spacing grows for images of more than 1 MP."""
MAX_DISTANCE_PX = 0.7
"""Largest epipolar distance of a pair; more if the correspondences are noisier."""
MIN_GROWN = 100
"""Least number of grown pairs for the pose."""
MOVED_RAD = np.deg2rad(0.5)
"""Change of the pose from which pairs are grown again."""
MAX_GROWTHS = 3
POSE_STEP_RAD = 1e-5
"""Step of forward differences of planes: far above rounding, far below any curvature."""
EXACT = 1e-12
"""Variances of the pose below this part of the largest are rounding and get no axis."""
SHARED_ERROR = 0.5
"""Error added to that of every pair, over their median: no pair is much better than others (by maximum likelihood)."""
WINDOW_OVERLAP = WINDOW_AREA_PX / POSE_STEP**2
"""Number of pairs for the pose whose windows share the same pixels."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DenseScene:
    """A dense cloud, and the grid that it was grown on.

    Attributes
    ----------
    scene : the scene with the dense cloud; its correspondences are those of `grown`, row by row.
    grown : the pairs.
    surface : the planes at their nodes, in the unit of the scene.
    nodes : (K,) row-major index of the node of each point of the cloud.
    of_calibrations : part of the K points' sigmas (mm, rad) by the calibrations, which is common to all points.
    """

    scene: SceneReconstruction
    grown: GrownPatches
    surface: GrownSurface
    nodes: NDArray[np.int64]
    of_calibrations: tuple[FloatArray, FloatArray]

    @property
    def correspondences(self) -> Correspondences:
        """All pairs that were grown."""
        return self.grown.correspondences()

    def maps(self) -> dict[str, NDArray[np.float64]]:
        """Return depth (along the axis of camera 1), range and normals at the nodes in image 1.

        Arrays (R, C) and (R, C, 3) with `pixels` (R, C, 2); NaN without a surface.
        """
        r = self.scene.reconstruction
        step, shape = self.grown.step, self.surface.valid.shape
        pixels = np.stack(np.meshgrid(*(step * np.arange(float(n)) for n in shape[::-1])), axis=-1)
        rays, seen = r.camera1.unproject(pixels)
        plane = np.full((*shape, 3), np.nan)
        known = np.zeros(seen.size, dtype=bool)
        known[self.nodes] = True
        known &= seen.ravel()
        plane.reshape(-1, 3)[known] = self.surface.plane.reshape(-1, 3)[known]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = 1.0 / np.sum(plane * rays, axis=-1)
            normals = -plane / np.linalg.norm(plane, axis=-1, keepdims=True)
        return {"pixels": pixels, "depth": distance * rays[..., 2], "range": distance, "normals": normals}


def grow_scene(
    sparse: SceneReconstruction,
    seeds: Correspondences,
    image1: NDArray[np.generic],
    image2: NDArray[np.generic],
    *,
    pose_is_known: bool = False,
    calibrations: Calibrations | None = None,
) -> DenseScene:
    """Return the dense cloud of two images whose `seeds` gave the reconstruction `sparse`.

    With `pose_is_known` the pose is not estimated again. With `calibrations`, the cameras with their covariance (for a
    rig including the pose, which is then known), their uncertainty is propagated to the pose and the cloud's sigmas.

    Raises DegenerateError if nothing grows from the seeds.
    """
    r = sparse.reconstruction
    view1 = GrowingView.of(grey_of(image1, "image 1"), r.camera1)
    view2 = GrowingView.of(grey_of(image2, "image 2"), r.camera2)
    agreeing = seeds.select(sparse.inliers)
    there = PosedPair(r.camera1, r.camera2, r.cam2_from_cam1)
    moved = [] if calibrations is None else moved_pairs(there, calibrations)
    fixed = KnownPose(r.cam2_from_cam1, moved=tuple(moved)) if pose_is_known else None
    even = _pose_from_grown(view1, view2, agreeing, sparse, fixed)
    pose, covariance = in_unit(even.pose.cam2_from_cam1, even.pose.covariance, r.baseline_mm)
    known = _epipolar_constraint(even.matches, pose)
    step = max(CLOUD_STEP, round(float(np.sqrt(np.prod(view1.size_px) / CLOUD_NODES))))
    grown = grow_in_both_directions(view1, view2, agreeing, step=step, known=known).centred()
    grown = correct_curvature(grown, r.camera1, r.camera2, pose)
    if not len(grown):
        raise DegenerateError(
            f"no surface grows from {len(agreeing)} correspondences; check that the images are sharp and "
            "show surfaces with texture"
        )
    views = PosedViews(view1, view2, pose)
    grown, sweep = fill_by_sweep(grown, PairRays.of(grown, r.camera1, r.camera2).measured(pose), views)
    rays = PairRays.of(grown, r.camera1, r.camera2)
    measured = rays.measured(pose)
    surface = fit_surface(measured, step, even.pose.epipolar_rms_px)
    if sweep is not None:
        surface = surface.where(at_best_depth(surface, grown, measured.slope, sweep, view1))
        surface, grown = fill_holes(surface, grown, sweep, views, even.pose.epipolar_rms_px)
        rays = PairRays.of(grown, r.camera1, r.camera2)
    by_pose = _planes_by_pose(rays, pose, covariance)
    moves = _moved_by_calibration(even, r, moved, pose_is_known=pose_is_known)
    covariance = covariance + sum((np.outer(m.change, m.change) for m in moves), np.zeros((6, 6)))
    cloud, nodes, of_calibrations = _cloud(grown, surface, by_pose, _planes_by_calibration(rays, pose, moves), image1)
    cloud = replace(cloud, calibration_in_sigmas=calibrations is not None)
    scene = _scene(sparse, grown, cloud, nodes, known, pose, covariance)
    return DenseScene(scene=scene, grown=grown, surface=surface, nodes=nodes, of_calibrations=of_calibrations)


def _scene(
    sparse: SceneReconstruction,
    grown: GrownPatches,
    cloud: OrientedCloud,
    nodes: NDArray[np.int64],
    known: EpipolarConstraint,
    pose: Rigid3,
    covariance: FloatArray,
) -> SceneReconstruction:
    """Return the scene of the cloud whose row k is node `nodes[k]` of the grown pairs."""
    r = sparse.reconstruction
    matches, seen = grown.correspondences().matches(r.camera1, r.camera2)
    chosen = np.cumsum(grown.valid.ravel())[nodes] - 1
    # A pair at the border of a field of view has no match; nor has it a plane.
    matches = matches.select(np.cumsum(seen)[chosen] - 1)
    dense = replace(
        r,
        affine_method="grown affinities",
        matches=matches,
        pixels1=matches.pixels1,
        pixels2=matches.pixels2,
        cam2_from_cam1=pose,
        pose_covariance=covariance,
        E21=essential_from_pose(pose),
        cloud=cloud,
        sampson_rms_px=float(np.sqrt(np.mean(_distances(matches, pose) ** 2))),
    )
    inliers = np.zeros(len(seen), dtype=bool)
    inliers[chosen] = True
    return SceneReconstruction(dense, sparse.metric, inliers, chosen, known.sigma_px, known.sigma_A)


class _PoseOfPairs(NamedTuple):
    """A pose, and the evenly spread pairs that gave it."""

    pose: SystematicPose
    matches: Matches


def _pose_from_grown(
    view1: GrowingView,
    view2: GrowingView,
    seeds: Correspondences,
    sparse: SceneReconstruction,
    fixed: KnownPose | None,
) -> _PoseOfPairs:
    """Return the pose of evenly spread pairs, which are grown again until it converges, or the `fixed` pose."""
    r = sparse.reconstruction
    pose = Rigid3(r.cam2_from_cam1.rotation, unit(r.cam2_from_cam1.translation_mm))
    cameras = view1.camera, view2.camera
    gate = max(MAX_DISTANCE_PX, GATE * sparse.sigma_px)
    for k in range(MAX_GROWTHS):
        known = EpipolarConstraint(essential_from_pose(pose), gate)
        grown = grow(view1, view2, seeds, step=POSE_STEP, known=known).centred()
        pairs = correct_curvature(grown, view1.camera, view2.camera, pose).correspondences()
        matches, _ = pairs.matches(view1.camera, view2.camera)
        if len(matches) < MIN_GROWN:
            raise DegenerateError(
                f"only {len(matches)} pairs grow from {len(seeds)} correspondences; the surfaces lack texture"
            )
        if fixed is not None:
            kept = known_scene_pose(matches, fixed)
            even = kept.matches.select(kept.inliers)
            # The pose is kept; this measures the lens errors across epipolar lines, which also act along them.
            there = kept.refined.cam2_from_cam1
            found = pose_with_lens_errors(even, cameras, there, PoseType.STANDARD, None, WINDOW_OVERLAP)
            return _PoseOfPairs(replace(found, cam2_from_cam1=there, covariance=kept.refined.covariance), even)
        # Without a level the type is exact.
        level = r.level_sigma_rad or 0.0
        fit = fit_scene_pose(_with_sigma_floor(matches), r.pose_type, level, np.random.default_rng(0), start=pose)
        even = fit.matches.select(fit.inliers)
        found = pose_with_lens_errors(
            even, cameras, fit.refined.cam2_from_cam1, fit.pose_type, fit.level_sigma_rad, WINDOW_OVERLAP
        )
        before, pose = pose, found.cam2_from_cam1
        turn = rotation_angle(pose.rotation @ before.rotation.T)
        swing = np.arccos(np.clip(pose.translation_mm @ before.translation_mm, -1.0, 1.0))
        gate = MAX_DISTANCE_PX
        if max(turn, swing) < MOVED_RAD or k == MAX_GROWTHS - 1:
            break
    return _PoseOfPairs(found, even)


def _with_sigma_floor(matches: Matches) -> Matches:
    """Return the matches with SHARED_ERROR added to their sigmas, which the images do not show."""
    sigma = np.hypot(matches.sigma1_px, SHARED_ERROR * np.median(matches.sigma1_px))
    return replace(matches, sigma1_px=sigma, sigma2_px=sigma)


def _distances(matches: Matches, pose: Rigid3) -> FloatArray:
    return sampson_of_matches(essential_from_pose(pose), matches)


def _epipolar_constraint(matches: Matches, pose: Rigid3) -> EpipolarConstraint:
    """Return the epipolar constraint of the pose, with sigmas from the residuals of its pairs."""
    # Sampson's distance moves both pixels; growing moves only that in image 2.
    sigma, E21 = np.sqrt(2.0) * robust_sigma(_distances(matches, pose)), essential_from_pose(pose)
    return EpipolarConstraint(E21, max(MAX_DISTANCE_PX, GATE * sigma), sigma, estimate_sigma_A(matches, E21))


def _planes_by_pose(rays: PairRays, pose: Rigid3, covariance: FloatArray) -> FloatArray:
    """Return the change (R, C, 3, K) of the nodes' own planes by one standard deviation of the pose along each of the K
    principal axes of its covariance that are not exact."""
    length = float(np.linalg.norm(pose.translation_mm))
    t = pose.translation_mm / length
    directions = pose_directions(t)
    to_five = directions / np.array([1.0, 1.0, 1.0, length, length, length])
    variances, axes = np.linalg.eigh(to_five @ covariance @ to_five.T)
    moves = np.flatnonzero(variances > EXACT * variances[-1])

    def planes(step: FloatArray) -> FloatArray:
        there = Rigid3(exp_so3(step[:3]) @ pose.rotation, length * unit(t + step[3:]))
        return rays.planes(there)

    changes = np.zeros((*rays.grown.valid.shape, 3, len(moves)))
    here = rays.planes(pose) if len(moves) else changes
    # Forward differences suffice for sigmas.
    for k, axis in enumerate(moves):
        change = planes(POSE_STEP_RAD * axes[:, axis] @ directions) - here
        changes[..., k] = np.sqrt(variances[axis]) / POSE_STEP_RAD * change
    return changes


class _MovedCameras(NamedTuple):
    """Cameras moved by one standard deviation along an axis of their covariance, and the resulting change (6,) of the
    pose: left rotation perturbation, rad, and translation."""

    cameras: tuple[Camera, Camera]
    change: FloatArray


def _moved_by_calibration(
    even: _PoseOfPairs, r: Reconstruction, moved: list[PosedPair], *, pose_is_known: bool
) -> list[_MovedCameras]:
    """Return the moved cameras with the change of the pose: that of `moved` if it is known, else by the same pairs."""
    here, out = r.cam2_from_cam1, []
    for camera1, camera2, there in moved:
        cameras = camera1, camera2
        change = there.step_from(here) if pose_is_known else _change_of_pose(even, r, cameras)
        out.append(_MovedCameras(cameras, change))
    return out


def _change_of_pose(even: _PoseOfPairs, r: Reconstruction, cameras: tuple[Camera, Camera]) -> FloatArray:
    """Return the change (6,) of the pose of the same pairs with other cameras."""
    pose, m = even.pose.cam2_from_cam1, even.matches
    t = pose.translation_mm
    seen = np.flatnonzero(visible_in_all([cameras], m.pixels1, m.pixels2))
    here = m.select(seen)
    there = here.with_cameras(*cameras)
    before, after = (point_terms(each, pose.rotation, t, translation_basis(t))[0] for each in (here, there))
    return np.asarray(np.repeat([1.0, r.baseline_mm], 3) * (even.pose.by_distance[:, seen] @ (after - before)))


def _planes_by_calibration(rays: PairRays, pose: Rigid3, moves: list[_MovedCameras]) -> FloatArray:
    """Return the change (R, C, 3, M) of the nodes' own planes by each move."""
    planes = np.zeros((*rays.grown.valid.shape, 3, len(moves)))
    here = rays.planes(pose) if moves else planes
    for k, (cameras, change) in enumerate(moves):
        planes[..., k] = PairRays.of(rays.grown, *cameras).planes(pose.moved(change)) - here
    return planes


def _cloud(
    grown: GrownPatches,
    surface: GrownSurface,
    by_pose: FloatArray,
    by_calibrations: FloatArray,
    image1: NDArray[np.generic],
) -> tuple[OrientedCloud, NDArray[np.int64], tuple[FloatArray, FloatArray]]:
    """Return the cloud of the planes with a certain range, their nodes, and the part of its sigmas (mm, rad) by the
    calibrations.

    `by_pose` (R, C, 3, K) and `by_calibrations` (R, C, 3, M) are changes of the planes by one standard deviation.
    """
    at = np.flatnonzero(surface.valid.ravel())

    def flat(values: FloatArray) -> FloatArray:
        return values.reshape(grown.valid.size, *values.shape[2:])[at]

    points, normals, plane, covariance = (
        flat(v) for v in (surface.points, surface.normals, surface.plane, surface.covariance)
    )
    by_pose, moves = flat(by_pose), flat(by_calibrations)
    of_calibrations = moves @ np.swapaxes(moves, 1, 2)
    covariance = covariance + by_pose @ np.swapaxes(by_pose, 1, 2) + of_calibrations
    size = np.linalg.norm(points, axis=1)
    ray = points / size[:, None]
    across = np.eye(3) - normals[:, :, None] * normals[:, None, :]

    def sigmas(of_plane: FloatArray) -> tuple[FloatArray, FloatArray]:
        of_normal = across @ of_plane @ across / np.sum(plane**2, axis=1)[:, None, None]
        return (
            size**2 * np.sqrt(np.einsum("ni,nij,nj->n", ray, of_plane, ray)),
            np.sqrt(np.trace(of_normal, axis1=1, axis2=2)),
        )

    sigma_mm, normal_sigma = sigmas(covariance)
    sure = np.isfinite(sigma_mm) & (sigma_mm < MAX_RANGE_SIGMA * size)
    if not sure.any():
        raise DegenerateError(NO_DISTANCE)
    count = int(sure.sum())
    cloud = OrientedCloud(
        points_mm=points[sure],
        normals=normals[sure],
        colours=colours_at(image1, flat(grown.pixels1)[sure]),
        board_index=np.full(count, -1),
        grid=np.zeros((count, 2), dtype=np.int64),
        sigma_mm=sigma_mm[sure],
        normal_sigma_rad=normal_sigma[sure],
        board_ids=(),
        from_origin=True,
    )
    share_mm, share_rad = sigmas(of_calibrations)
    return cloud, at[sure], (share_mm[sure], share_rad[sure])
