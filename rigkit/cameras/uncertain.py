"""Cameras with covariance, for everything that propagates it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, principal_axes
from rigkit.core.errors import InputError
from rigkit.geometry.relative_pose import relative_pose, relative_pose_jacobian
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

Moved = TypeVar("Moved")
MAX_HALVINGS = 4
"""Of a standard deviation that leaves the range of a parameter both ways, as that of alpha (0 to 1) of a double-sphere
lens does that a few images determine together with xi only; a sixteenth, 256 times, is the most that is computed."""


@dataclass(frozen=True, eq=False, slots=True)
class UncertainCamera:
    """A camera and the covariance (P, P) of its parameters: of their errors about zero. Its part `expected` (P, P) is
    that of errors whose mean is not zero; None: all means are zero."""

    camera: Camera
    covariance: FloatArray
    expected: FloatArray | None = None

    def moved(self) -> list[Camera]:
        """Return the camera changed by one standard deviation along each principal axis of the covariance. The axes are
        independent: the variance of a quantity is the sum of its squared changes."""
        camera = self.camera
        return _either_way(lambda axis: camera.with_parameters(camera.parameters + axis), self.covariance)


class PosedPair(NamedTuple):
    """Two cameras and their relative pose, mm."""

    camera1: Camera
    camera2: Camera
    cam2_from_cam1: Rigid3


@dataclass(frozen=True, eq=False, slots=True)
class UncertainPair:
    """Two cameras on one mount and the joint covariance (P, P) of the parameters of both and of the relative pose: left
    rotation perturbation, rad, and translation, mm."""

    posed: PosedPair
    covariance: FloatArray

    def moved(self) -> list[PosedPair]:
        """Return the pair changed by one standard deviation along each principal axis, as `UncertainCamera.moved`."""
        one, two, pose = self.posed
        end1 = one.parameters.size
        end2 = end1 + two.parameters.size
        return _either_way(
            lambda axis: PosedPair(
                one.with_parameters(one.parameters + axis[:end1]),
                two.with_parameters(two.parameters + axis[end1:end2]),
                Rigid3(exp_so3(axis[end2 : end2 + 3]) @ pose.rotation, pose.translation_mm + axis[end2 + 3 :]),
            ),
            self.covariance,
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class UncertainRig:
    """Cameras of a rig with covariance.

    Attributes
    ----------
    cameras, cam_from_rig : all cameras with their mounts; the first defines the rig's frame.
    covariance : (G, G) of the parameters, camera by camera, then of the mounts of all cameras but the first: left
        rotation perturbation, rad, and translation, mm.
    scale_sigma : relative standard deviation of all lengths.
    """

    cameras: Sequence[Camera]
    cam_from_rig: Sequence[Rigid3]
    covariance: FloatArray
    scale_sigma: float = 0.0

    def pair(self, first: int, second: int) -> UncertainPair:
        """Return two of the cameras with the joint covariance of their parameters and relative pose."""
        ends = np.cumsum([0, *(camera.parameters.size for camera in self.cameras)])
        unknowns = np.eye(len(self.covariance))
        mounts = self.cam_from_rig[first], self.cam_from_rig[second]
        pose, by_mounts = relative_pose(*mounts), relative_pose_jacobian(*mounts)
        of_pose = np.zeros((6, len(unknowns)))
        for k, by_mount in zip((first, second), np.split(by_mounts, 2, axis=1), strict=True):
            if k > 0:
                of_pose += by_mount @ unknowns[ends[-1] + 6 * (k - 1) :][:6]
        rows = np.concatenate([*(unknowns[ends[k] : ends[k + 1]] for k in (first, second)), of_pose])
        covariance = rows @ self.covariance @ rows.T
        longer = self.scale_sigma * pose.translation_mm
        covariance[-3:, -3:] += np.outer(longer, longer)
        return UncertainPair(PosedPair(self.cameras[first], self.cameras[second], pose), covariance)


def _either_way(moved: Callable[[FloatArray], Moved], covariance: FloatArray) -> list[Moved]:
    """Return what is `moved` along each principal axis, or against it where that leaves the range of a parameter: the
    square of a change is the same. Where both leave it, what is moved by a half stands there four times, and so on: the
    sum of squared changes is the same."""
    return [one for axis in principal_axes(covariance) for one in _in_range(moved, axis)]


def _in_range(moved: Callable[[FloatArray], Moved], axis: FloatArray) -> list[Moved]:
    for halvings in range(MAX_HALVINGS + 1):
        for signed in (axis, -axis):
            try:
                return [moved(signed / 2**halvings)] * 4**halvings
            except InputError as error:
                refused = error
    raise refused
