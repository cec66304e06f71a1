"""Cameras and how sure they are: what all that is measured with them propagates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.geometry.principal_axes import principal_axes
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew


@dataclass(frozen=True, eq=False, slots=True)
class UncertainCamera:
    """A camera and the covariance (P, P) of its parameters."""

    camera: Camera
    covariance: FloatArray

    def moved(self) -> list[Camera]:
        """Return the camera moved by one standard deviation along each principal axis of the covariance. The axes are
        independent: the squares of what they change in a quantity add up to its variance."""
        camera = self.camera
        return [camera.with_parameters(camera.parameters + axis) for axis in principal_axes(self.covariance)]


class PosedPair(NamedTuple):
    """Two cameras, and the pose between them, mm."""

    camera1: Camera
    camera2: Camera
    cam2_from_cam1: Rigid3


@dataclass(frozen=True, eq=False, slots=True)
class UncertainPair:
    """Two cameras on one mount and the covariance (P, P) of the parameters of both and of the pose between them: left
    rotation perturbation, rad, and translation, mm. What lenses and mount err by together is in it."""

    posed: PosedPair
    covariance: FloatArray

    def moved(self) -> list[PosedPair]:
        """Return the pair moved by one standard deviation along each principal axis of the covariance, see
        `UncertainCamera.moved`."""
        one, two, pose = self.posed
        end1 = one.parameters.size
        end2 = end1 + two.parameters.size
        return [
            PosedPair(
                one.with_parameters(one.parameters + axis[:end1]),
                two.with_parameters(two.parameters + axis[end1:end2]),
                Rigid3(exp_so3(axis[end2 : end2 + 3]) @ pose.rotation, pose.translation_mm + axis[end2 + 3 :]),
            )
            for axis in principal_axes(self.covariance)
        ]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class UncertainRig:
    """Cameras of a rig and how sure they are.

    Attributes
    ----------
    cameras, cam_from_rig : of all cameras, the first is the rig's frame.
    covariance : (G, G) of the parameters, camera by camera, then of the mounts of all cameras but the first: left
        rotation perturbation, rad, and translation, mm.
    scale_sigma : relative standard deviation of all lengths.
    """

    cameras: Sequence[Camera]
    cam_from_rig: Sequence[Rigid3]
    covariance: FloatArray
    scale_sigma: float = 0.0

    def pair(self, first: int, second: int) -> UncertainPair:
        """Return two of the cameras, and how sure they and the pose between them are."""
        ends = np.cumsum([0, *(camera.parameters.size for camera in self.cameras)])
        unknowns = np.eye(len(self.covariance))
        pose = self.cam_from_rig[second] @ self.cam_from_rig[first].inverse()
        # How R2 R1^T and t2 - R2 R1^T t1 move with each mount, R <- exp(w) R, t <- t + dt.
        turn, arm = pose.rotation, skew(pose.rotation @ self.cam_from_rig[first].translation_mm)
        by_first = np.block([[-turn, np.zeros((3, 3))], [-arm @ turn, -turn]])
        by_second = np.block([[np.eye(3), np.zeros((3, 3))], [arm, np.eye(3)]])
        of_pose = np.zeros((6, len(unknowns)))
        for k, by_mount in ((first, by_first), (second, by_second)):
            if k > 0:
                of_pose += by_mount @ unknowns[ends[-1] + 6 * (k - 1) :][:6]
        rows = np.concatenate([*(unknowns[ends[k] : ends[k + 1]] for k in (first, second)), of_pose])
        covariance = rows @ self.covariance @ rows.T
        longer = self.scale_sigma * pose.translation_mm
        covariance[-3:, -3:] += np.outer(longer, longer)
        return UncertainPair(PosedPair(self.cameras[first], self.cameras[second], pose), covariance)
