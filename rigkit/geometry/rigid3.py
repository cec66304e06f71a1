"""Rigid motions named target_from_source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rigkit.core.arrays import FloatArray, Mat3, Points, as_array, as_floats
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import exp_so3, log_so3, nearest_rotation, unit

ROTATION_TOLERANCE = 1e-4
"""Deviation from orthonormal that is a mistake (a scale, a transposed homogeneous matrix), not rounding."""
ROUNDING = 1e-9
"""Deviation up to which one Newton step makes a matrix orthonormal to the last digit, without singular values."""


@dataclass(frozen=True, eq=False, slots=True, init=False)
class Rigid3:
    """A rigid motion: `x_in_b = b_from_a.apply(x_in_a)`.

    Attributes
    ----------
    rotation : (3, 3) rotation matrix; rounding is removed, anything worse is refused.
    translation_mm : (3,)

    >>> import numpy as np
    >>> cam2_from_cam1 = Rigid3(np.eye(3), [-300.0, 0.0, 0.0])
    >>> cam2_from_cam1.apply(np.array([0.0, 0.0, 1000.0])).tolist()
    [-300.0, 0.0, 1000.0]
    >>> (cam2_from_cam1.inverse() @ cam2_from_cam1).translation_mm.tolist()
    [0.0, 0.0, 0.0]
    """

    rotation: Mat3
    translation_mm: FloatArray

    def __init__(self, rotation: ArrayLike, translation_mm: ArrayLike) -> None:
        matrix = as_array(rotation, (3, 3), "rotation")
        object.__setattr__(self, "rotation", as_array(_checked(matrix), (3, 3), "rotation"))
        object.__setattr__(self, "translation_mm", as_array(translation_mm, (3,), "translation_mm"))

    @classmethod
    def stack(cls, rotation: Mat3, translation_mm: FloatArray) -> tuple[Rigid3, ...]:
        """Return the motions of rotations (N, 3, 3) and translations (N, 3), checked all at once."""
        rotation = _checked(as_array(rotation, (None, 3, 3), "rotation"))
        translation = as_array(translation_mm, (len(rotation), 3), "translation_mm")
        rotation.flags.writeable = False
        return tuple(cls._of(one, shift) for one, shift in zip(rotation, translation, strict=True))

    @classmethod
    def _own(cls, rotation: Mat3, translation_mm: FloatArray) -> Rigid3:
        """Return the motion of newly allocated arrays, without checks: they come from motions that were checked."""
        rotation.flags.writeable = translation_mm.flags.writeable = False
        return cls._of(rotation, translation_mm)

    @classmethod
    def _of(cls, rotation: Mat3, translation_mm: FloatArray) -> Rigid3:
        """Return the motion of read-only arrays, without checks."""
        motion = object.__new__(cls)
        object.__setattr__(motion, "rotation", rotation)
        object.__setattr__(motion, "translation_mm", translation_mm)
        return motion

    @classmethod
    def identity(cls) -> Rigid3:
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Rigid3:
        """Build from a 4x4 (or 3x4) matrix in mm."""
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape not in ((4, 4), (3, 4)):
            raise InputError(f"rigid motion: expected a 4x4 or 3x4 matrix, got shape {m.shape}")
        return cls(m[:3, :3], m[:3, 3])

    def matrix(self) -> FloatArray:
        """Return the 4x4 matrix."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation_mm
        return out

    def apply(self, points: Points) -> Points:
        """Map points (..., 3) from the source frame to the target frame."""
        return as_floats(points, (3,), "points") @ self.rotation.T + self.translation_mm

    def moved(self, step: FloatArray) -> Rigid3:
        """Return the motion after a small step (w, v) (6,), rad and mm: R' = exp([w]x) R, t' = t + v.

        Every covariance of a pose in the package is of such a step.
        """
        return Rigid3(exp_so3(step[:3]) @ self.rotation, self.translation_mm + step[3:])

    def step_from(self, other: Rigid3) -> FloatArray:
        """Return the step (6,) from `other` to this motion: `other.moved(step)` is this one."""
        turn = log_so3(self.rotation @ other.rotation.T)
        return np.concatenate([turn, self.translation_mm - other.translation_mm])

    def inverse(self) -> Rigid3:
        back = self.rotation.T.copy()
        return Rigid3._own(back, -back @ self.translation_mm)

    def __matmul__(self, other: Rigid3) -> Rigid3:
        if not isinstance(other, Rigid3):
            return NotImplemented
        rotation = _orthonormal(self.rotation @ other.rotation)
        return Rigid3._own(rotation, self.rotation @ other.translation_mm + self.translation_mm)

    def allclose(self, other: Rigid3, *, rotation_tol: float = 1e-9, translation_tol_mm: float = 1e-9) -> bool:
        """Say whether two motions agree entry by entry."""
        return bool(
            np.allclose(self.rotation, other.rotation, rtol=0.0, atol=rotation_tol)
            and np.allclose(self.translation_mm, other.translation_mm, rtol=0.0, atol=translation_tol_mm)
        )


def _checked(matrix: Mat3) -> Mat3:
    """Return the rotations nearest to `matrix` (..., 3, 3); raises InputError if one differs by more than rounding."""
    off = _orthonormality_error(matrix)
    if np.abs(off).max(initial=0.0) <= ROUNDING and (np.linalg.det(matrix) > 0.0).all():
        return _orthonormal(matrix, off)
    nearest = nearest_rotation(matrix)
    if np.abs(nearest - matrix).max(initial=0.0) > ROTATION_TOLERANCE:
        raise InputError("rotation: not a rotation matrix (orthonormal, determinant +1); check scale and order")
    return nearest


def _orthonormality_error(matrix: Mat3) -> Mat3:
    """Return M^T M - I of matrices (..., 3, 3)."""
    return np.asarray(np.swapaxes(matrix, -1, -2) @ matrix - np.eye(3))


def _orthonormal(matrix: Mat3, off: Mat3 | None = None) -> Mat3:
    """Return matrices (..., 3, 3) that are rotations up to rounding, made orthonormal: one step of Newton's iteration
    for the polar factor, which squares the deviation `off`."""
    return np.asarray(matrix - 0.5 * (matrix @ (_orthonormality_error(matrix) if off is None else off)))


def cam_from_world_look_at(eye_mm: ArrayLike, target_mm: ArrayLike, down: ArrayLike = (0.0, 1.0, 0.0)) -> Rigid3:
    """Return cam_from_world of a camera at `eye_mm` that looks at `target_mm`, with its y axis towards `down`.

    Raises InputError where eye and target coincide or the viewing direction is parallel to `down`.
    """
    eye = as_array(eye_mm, (3,), "eye_mm")
    z = unit(as_array(target_mm, (3,), "target_mm") - eye)
    x = unit(np.cross(as_array(down, (3,), "down"), z))
    if not np.isfinite(x).all():
        raise InputError("look_at: eye and target coincide, or the view is parallel to `down`")
    rotation = np.stack([x, np.cross(z, x), z])
    return Rigid3(rotation, -rotation @ eye)
