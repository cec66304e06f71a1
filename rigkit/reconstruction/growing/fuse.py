"""Fuse the clouds of several pairs of views with known poses.

A point of a later cloud is projected into the camera of an earlier one. If its distance to the surface there, along the
normal, is within the errors of both, the two are merged, weighted by these errors. Distances along the surface do not
matter, because both clouds are samples of it. Calibration errors separate clouds as noise does, but are not averaged by
merging: they are common to all points of a pair, and to pairs with a common camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew, unit
from rigkit.reconstruction.growing.dense import DenseScene
from rigkit.reconstruction.scene_pose import GATE

MAX_TURN_DEG = 45.0
"""Largest angle between normals of merged points: both sides of a thin board are two surfaces."""
REACH_STEPS = 1.0
"""Largest distance to the nearest node of the earlier cloud, in its node spacing."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PosedCloud:
    """The cloud of one pair of views, in the frame of its first camera.

    Attributes
    ----------
    cloud : N points.
    of_calibrations : part of its sigmas (N,) (mm, rad) by the calibrations.
    pixels, step_px : (N, 2) of the points in the first image, and the node spacing.
    camera, world_from_cam : the first camera and its pose.
    pose_covariance : (6, 6) of that pose: left rotation perturbation, rad, and translation, mm.
    """

    cloud: OrientedCloud
    of_calibrations: tuple[FloatArray, FloatArray]
    pixels: Pixels
    step_px: float
    camera: Camera
    world_from_cam: Rigid3
    pose_covariance: FloatArray

    @classmethod
    def of(cls, dense: DenseScene, world_from_cam1: Rigid3, pose_covariance: FloatArray | None = None) -> PosedCloud:
        """Return the cloud of a dense scene with the pose of its first camera, exact without a covariance."""
        r = dense.scene.reconstruction
        return cls(
            cloud=r.cloud,
            of_calibrations=dense.of_calibrations,
            pixels=r.pixels1,
            step_px=float(dense.grown.step),
            camera=r.camera1,
            world_from_cam=world_from_cam1,
            pose_covariance=np.zeros((6, 6)) if pose_covariance is None else pose_covariance,
        )


@dataclass(frozen=True, eq=False, slots=True)
class FusedCloud:
    """A cloud of several pairs.

    Attributes
    ----------
    cloud : in the world's frame; every normal faces the camera that saw its point.
    pairs_of : (N,) int, number of pairs whose points were merged into each.
    source : (N,) int, index of the cloud that each point is from.
    """

    cloud: OrientedCloud
    pairs_of: IntArray
    source: IntArray


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _MergedSurface:
    """A cloud in the world frame, and the weighted sums of the points merged into it.

    Attributes
    ----------
    sigma, errors, variance : (N,) sigma of the points' noise, (N, 3) the same along rays, (N,) variance along normals.
    common : (N, 3, 3) mm^2 covariance by pose and calibrations.
    common_sums : (N,) weighted sum of the largest standard deviations of `common`.
    common_rad : (N,) sigma of the normals by pose and calibrations.
    """

    posed: PosedCloud
    points: FloatArray
    normals: FloatArray
    sigma: FloatArray
    errors: FloatArray
    variance: FloatArray
    common: FloatArray
    common_sums: FloatArray
    common_rad: FloatArray
    keep: BoolArray
    weights: FloatArray
    offsets: FloatArray
    normal_weights: FloatArray
    normal_sums: FloatArray
    colour_sums: FloatArray
    counts: NDArray[np.int64]


def fuse_clouds(clouds: Sequence[PosedCloud]) -> FusedCloud:
    """Return the clouds of several pairs as one, with points of the same surface merged by their covariances.

    Merging reduces only independent noise, not the errors of poses and calibrations. Raises InputError without clouds.
    """
    if not clouds:
        raise InputError("clouds: no cloud to fuse")
    # The most certain clouds come first: others are merged into them.
    order = sorted(range(len(clouds)), key=lambda k: float(np.median(clouds[k].cloud.sigma_mm)))
    surfaces: list[_MergedSurface] = []
    for k in order:
        later = _surface(clouds[k])
        for earlier in surfaces:
            _merge(earlier, later)
        surfaces.append(later)
    return _fused(surfaces, order)


def _surface(posed: PosedCloud) -> _MergedSurface:
    cloud, turn, (common_mm, common_rad) = posed.cloud, posed.world_from_cam.rotation, posed.of_calibrations
    points, normals, rays = (values @ turn.T for values in (cloud.points_mm, cloud.normals, unit(cloud.points_mm)))
    sigma = np.sqrt(np.maximum(cloud.sigma_mm**2 - common_mm**2, 0.0))
    errors = sigma[:, None] * rays
    variance = _variance(errors, normals)
    by_pose = np.concatenate([-skew(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
    common = by_pose @ posed.pose_covariance @ np.swapaxes(by_pose, 1, 2)
    common += (common_mm**2)[:, None, None] * rays[:, :, None] * rays[:, None, :]
    of_turn = posed.pose_covariance[:3, :3]
    of_normal = np.trace(of_turn) - np.einsum("ni,ij,nj->n", normals, of_turn, normals)
    sure = _information(np.sqrt(np.maximum(cloud.normal_sigma_rad**2 - common_rad**2, 0.0)))
    return _MergedSurface(
        posed=posed,
        points=posed.world_from_cam.apply(cloud.points_mm),
        normals=normals,
        sigma=sigma,
        errors=errors,
        variance=variance,
        common=common,
        common_sums=np.sqrt(np.maximum(np.linalg.eigvalsh(common)[:, -1], 0.0)) / variance,
        common_rad=np.sqrt(common_rad**2 + np.maximum(of_normal, 0.0)),
        keep=np.ones(len(cloud), dtype=bool),
        weights=1.0 / variance,
        offsets=np.zeros(len(cloud)),
        normal_weights=sure,
        normal_sums=sure[:, None] * normals,
        colour_sums=cloud.colours.astype(np.float64),
        counts=np.ones(len(cloud), dtype=np.int64),
    )


def _variance(errors: FloatArray, normals: FloatArray) -> FloatArray:
    """Return the variance of a distance along normals for errors along rays; infinite if unknown."""
    variance = np.sum(errors * normals, axis=1) ** 2
    return np.where(np.isfinite(variance) & (variance > 0.0), variance, np.inf)


def _information(sigma: FloatArray) -> FloatArray:
    """Return 1 / sigma^2, with the median of the known sigmas for unknown ones."""
    known = np.isfinite(sigma) & (sigma > 0.0)
    typical = float(np.median(sigma[known])) if known.any() else 1.0
    return np.asarray(1.0 / np.where(known, sigma, typical) ** 2)


def _merge(earlier: _MergedSurface, later: _MergedSurface) -> None:
    """Merge points of `later` into `earlier`, and remove them from `later`."""
    from scipy.spatial import cKDTree

    posed = earlier.posed
    left = np.flatnonzero(later.keep & np.isfinite(later.variance))
    pixels, seen = posed.camera.project(posed.world_from_cam.inverse().apply(later.points[left]))
    left, pixels = left[seen], pixels[seen]
    there = np.flatnonzero(earlier.keep & np.isfinite(earlier.variance))
    if not left.size or not there.size:
        return
    reach = REACH_STEPS * posed.step_px
    distance, nearest = cKDTree(posed.pixels[there]).query(pixels, distance_upper_bound=reach)
    left, into = left[np.isfinite(distance)], there[nearest[np.isfinite(distance)]]
    normal = earlier.normals[into]
    off = np.sum(normal * (later.points[left] - earlier.points[into]), axis=1)
    variance = _variance(later.errors[left], normal)
    common = np.einsum("ni,nij,nj->n", normal, earlier.common[into] + later.common[left], normal)
    both = np.sqrt(earlier.variance[into] + variance + common)
    turned = np.sum(normal * later.normals[left], axis=1) < np.cos(np.radians(MAX_TURN_DEG))
    same = (np.abs(off) < GATE * both) & ~turned
    left, into, off, variance = left[same], into[same], off[same], variance[same]
    np.add.at(earlier.offsets, into, off / variance)
    np.add.at(earlier.weights, into, 1.0 / variance)
    largest = later.common_sums[left] * later.variance[left]
    np.add.at(earlier.common_sums, into, largest / variance)
    for name in ("normal_weights", "normal_sums", "colour_sums", "counts"):
        np.add.at(getattr(earlier, name), into, getattr(later, name)[left])
    later.keep[left] = False


def _fused(surfaces: Sequence[_MergedSurface], order: Sequence[int]) -> FusedCloud:
    def joined(name: str) -> FloatArray:
        return np.concatenate([getattr(s, name)[s.keep] for s in surfaces])

    weights, counts, normals = (
        joined("weights"),
        np.concatenate([s.counts[s.keep] for s in surfaces]),
        joined("normals"),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        move = np.where(weights > 0.0, joined("offsets") / weights, 0.0)
        shrink = np.sqrt(1.0 / weights / joined("variance"))
        common = np.nan_to_num(joined("common_sums") / weights)
    sigma = joined("sigma") * np.nan_to_num(shrink, nan=1.0)
    count = len(counts)
    cloud = OrientedCloud(
        points_mm=joined("points") + move[:, None] * normals,
        normals=unit(joined("normal_sums")),
        colours=np.rint(joined("colour_sums") / counts[:, None]).astype(np.uint8),
        board_index=np.full(count, -1),
        grid=np.zeros((count, 2), dtype=np.int64),
        sigma_mm=np.hypot(sigma, common),
        normal_sigma_rad=np.sqrt(1.0 / joined("normal_weights") + joined("common_rad") ** 2),
        board_ids=(),
        calibration_in_sigmas=all(s.posed.cloud.calibration_in_sigmas for s in surfaces),
    )
    sizes = [int(s.keep.sum()) for s in surfaces]
    return FusedCloud(cloud, counts, np.repeat(np.array(order, dtype=np.int64), sizes))
