"""The purpose of a calibration as a weight W on the errors of the camera's parameters: the mean square error of the
quantity of interest is trace(W C), with C their covariance. That of a rig is on the errors of its lenses and mounts
together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.calibration.rig.certainty.uncertainty import RigProjection
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.core.arrays import FloatArray, IntArray, Pixels, Points, Rays
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew

GOAL_GRID = (24, 18)
"""Columns and rows of the pixels over which the goal is averaged."""
METRE_MM = 1000.0


class Aim(Protocol):
    """The criterion by which views are chosen: an error in `unit`, described by `what`, to be minimised."""

    @property
    def unit(self) -> str: ...

    @property
    def what(self) -> str: ...

    def error(self, covariance: FloatArray) -> FloatArray:
        """Return the error (...,) for covariances (..., T, T) of all parameters."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Goal:
    """The root of trace(`weight` C) as the error to minimise, in `unit`, described by `what`."""

    weight: FloatArray
    unit: str
    what: str

    def error(self, covariance: FloatArray) -> FloatArray:
        """Return the error (...,) for covariances (..., T, T); the camera's parameters are the first of T."""
        p = len(self.weight)
        return np.asarray(np.sqrt(np.maximum((self.weight * covariance[..., :p, :p]).sum(axis=(-1, -2)), 0.0)))

    def among(self, index: IntArray, count: int) -> Goal:
        """Return the goal for `count` unknowns, among which its own parameters have the indices `index` (P,)."""
        weight = np.zeros((count, count))
        weight[np.ix_(index, index)] = self.weight
        return replace(self, weight=weight)


@dataclass(frozen=True, eq=False, slots=True)
class Requirement:
    """The `wanted` error of a goal, in its unit, and its name `whose` in messages: "" where there is but one."""

    goal: Goal
    wanted: float
    whose: str = ""

    def remaining(self, covariance: FloatArray) -> RemainingError:
        """Return the error for a covariance, compared with the wanted one."""
        return RemainingError(self, float(self.goal.error(covariance)))


@dataclass(frozen=True, eq=False, slots=True)
class RemainingError:
    """The error of a goal compared with its requirement."""

    requirement: Requirement
    error: float

    @property
    def share(self) -> float:
        """As a part of the wanted error: reached at 1."""
        return self.error / self.requirement.wanted

    @property
    def reached(self) -> bool:
        return self.share <= 1.0

    def __str__(self) -> str:
        return f"{self.requirement.whose} {self.error:.2g} {self.requirement.goal.unit}".lstrip()


def projection_goal(camera: Camera, field_deg: float | None = None, pixels: Pixels | None = None) -> Goal:
    """Return the mean square error of the projection of points at infinity, after the best rotation: over the image, or
    its part within a field of view of `field_deg`; or at `pixels` (N, 2)."""
    if pixels is None:
        pixels = grid_pixels(camera.size_px, GOAL_GRID).reshape(-1, 2)
    rays = rays_within(camera, pixels, field_deg)
    left = rotation_free_jacobian(camera, rays).reshape(-1, camera.parameters.size)
    return Goal(left.T @ left / len(rays), "px", "rms error of the projection over the image")


def px_words(camera: Camera, error_px: float) -> str:
    """Return an error in the image in words: in px, and as the rms displacement over the image of points at 1 m."""
    pixels = grid_pixels(camera.size_px, GOAL_GRID).reshape(-1, 2)
    _, seen = camera.unproject(pixels)
    if not seen.any():
        return f"{error_px:.2g} px"
    by_pixel = camera.ray_jacobian(pixels[seen])
    aside = error_px * METRE_MM * float(np.sqrt(0.5 * (by_pixel**2).sum(axis=(-1, -2)).mean()))
    return f"{error_px:.2g} px, {aside:.2g} mm at 1 m"


def rotation_free_jacobian(camera: Camera, rays: Rays) -> FloatArray:
    """Return d pixel / d parameters along rays (N, 3) at infinity, (N, 2, P), after the rotation that compensates them
    best."""
    p = camera.parameters.size
    design = projection_design(camera, rays).transpose(2, 0, 1).reshape(-1, p + 3)
    turn = np.linalg.qr(design[:, p:])[0]
    left = design[:, :p] - turn @ (turn.T @ design[:, :p])
    return np.asarray(left.reshape(len(rays), 2, p))


def rays_within(camera: Camera, pixels: Pixels, field_deg: float | None) -> Rays:
    """Return the rays of those of `pixels` (N, 2) within the field of view."""
    rays, valid = camera.unproject(pixels)
    if field_deg is not None:
        with np.errstate(invalid="ignore"):
            valid &= rays[:, 2] >= np.cos(np.radians(0.5 * field_deg))
    return np.asarray(rays[valid])


def rig_goal(
    cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3], distance_mm: float, field_deg: float | None = None
) -> Goal:
    """Return the mean square error of the projections of all cameras, for points at a distance in front of each: errors
    of lenses and mounts together move the projections of one point in two cameras. The motion of the world, which
    boards leave undetermined, is chosen for the smallest error. Points are within a field of view of `field_deg`.

    Its weight is on the parameters of all cameras, then the mounts of all but the first (`Layout.of_cameras`): left
    rotation perturbation, rad, and translation, mm.
    """
    placed, layout = list(zip(cameras, cam_from_rig, strict=True)), Layout.of_cameras(cameras)
    points = np.concatenate([_points_in_view(c, pose, distance_mm, field_deg) for c, pose in placed])
    rows = np.concatenate([_design(c, pose, points, layout, k, field_deg) for k, (c, pose) in enumerate(placed)])
    # Rotations in radians and translations in millimetres, scaled to equal effects at the distance.
    motion = rows[:, layout.count :] / np.array([1.0, 1.0, 1.0, *[1.0 / distance_mm] * 3])
    along, _ = np.linalg.qr(motion)
    left = rows[:, : layout.count] - along @ (along.T @ rows[:, : layout.count])
    what = f"rms error of all projections at {distance_mm:.0f} mm, with extrinsics"
    return Goal(left.T @ left / (len(rows) / 2), "px", what)


def _points_in_view(camera: Camera, cam_from_rig: Rigid3, distance_mm: float, field_deg: float | None) -> Points:
    """Return points at a distance all over a camera's image, in the rig's frame."""
    rays = rays_within(camera, grid_pixels(camera.size_px, GOAL_GRID).reshape(-1, 2), field_deg)
    return cam_from_rig.inverse().apply(distance_mm * rays)


def _design(
    camera: Camera, cam_from_rig: Rigid3, points: Points, layout: Layout, k: int, field_deg: float | None
) -> FloatArray:
    """Return the derivatives (2 N, G + 6) of the pixels of the points that camera `k` sees: by the parameters of the
    layout, and by a motion of the world."""
    found = RigProjection.of(camera, cam_from_rig, points, layout, k)
    seen = found.seen
    if field_deg is not None:
        in_cam = cam_from_rig.apply(points)
        seen &= in_cam[:, 2] >= np.cos(np.radians(0.5 * field_deg)) * np.linalg.norm(in_cam, axis=-1)
    # x = R (exp(W) X + T) + t.
    by_world = found.d_pixels_d_point[seen]
    motion = np.concatenate([-by_world @ skew(points[seen]), by_world], axis=-1)
    return np.concatenate([found.d_pixels_d_globals[seen], motion], axis=-1).reshape(-1, layout.count + 6)
