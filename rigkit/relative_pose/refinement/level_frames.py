"""Level frames of tilted cameras whose vertical direction is known, from a vehicle mount or an accelerometer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3, as_array
from rigkit.core.errors import InputError
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

UPSIDE_DOWN = 1e-6
"""Smaller sines of the angle between `down` and the y axis count as zero: then any horizontal rotation axis will do."""


@dataclass(frozen=True, eq=False, slots=True)
class LevelFrames:
    """Rotations into frames whose y axis points down, in which planar motion is planar.

    Attributes
    ----------
    level1_from_cam1, level2_from_cam2 : (3, 3) rotations.
    """

    level1_from_cam1: Mat3
    level2_from_cam2: Mat3

    @classmethod
    def from_down(cls, down1: Sequence[float] | FloatArray, down2: Sequence[float] | FloatArray) -> LevelFrames:
        """Return the frames that differ by the smallest rotations from cameras in which `down` (3,) is vertical.

        Raises InputError for a direction of length zero.
        """
        return cls(_upright(down1), _upright(down2))

    def matches(self, matches: Matches) -> Matches:
        """Return the matches with rays and ray Jacobians in the level frames, without camera matrices.

        Pixels, affinities and sigmas do not change.
        """
        first, second = self.level1_from_cam1, self.level2_from_cam2
        return replace(
            matches,
            rays1=matches.rays1 @ first.T,
            rays2=matches.rays2 @ second.T,
            jacobians1=first @ matches.jacobians1,
            jacobians2=second @ matches.jacobians2,
            K1=None,
            K2=None,
        )

    def level_pose(self, cam2_from_cam1: Rigid3) -> Rigid3:
        """Return level2_from_level1."""
        rotation = self.level2_from_cam2 @ cam2_from_cam1.rotation @ self.level1_from_cam1.T
        return Rigid3(rotation, self.level2_from_cam2 @ cam2_from_cam1.translation_mm)

    def camera_pose(self, level2_from_level1: Rigid3) -> Rigid3:
        """Return cam2_from_cam1."""
        rotation = self.level2_from_cam2.T @ level2_from_level1.rotation @ self.level1_from_cam1
        return Rigid3(rotation, self.level2_from_cam2.T @ level2_from_level1.translation_mm)

    def camera_covariance(self, covariance: FloatArray) -> FloatArray:
        """Return the covariance (6, 6) of cam2_from_cam1 for that of level2_from_level1.

        Both perturbations, the left rotation and the translation, are vectors in the frame of the second camera.
        """
        turn = np.kron(np.eye(2), self.level2_from_cam2.T)
        return np.asarray(turn @ covariance @ turn.T)


def _upright(down: Sequence[float] | FloatArray) -> Mat3:
    """Return the smallest rotation that maps `down` to the y axis."""
    vector = as_array(down, (3,), "down")
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise InputError("down: a direction of length zero; give the direction that is down in the camera's frame")
    x, y, z = vector / length
    sine = float(np.hypot(x, z))
    axis = np.array([-z, 0.0, x]) / sine if sine > UPSIDE_DOWN else np.array([0.0, 0.0, 1.0])
    return exp_so3(axis * np.arctan2(sine, y))
