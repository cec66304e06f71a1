"""The solved movement of a lens's entrance pupil, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import PUPIL_TERMS, NearCamera, pupil_shift_mm
from rigkit.core.arrays import FloatArray, IntArray, keep_arrays
from rigkit.core.errors import InputError


@dataclass(frozen=True, eq=False, slots=True)
class SolvedPupil:
    """An entrance pupil that moves by s(t) = e1 t^2 + e2 t^4, mm along the optical axis, at the angle t from it.

    Attributes
    ----------
    terms : (2,) e1 and e2, mm rad^-2 and mm rad^-4.
    covariance : (2, 2) of the terms, as that of the camera's parameters.
    with_frame : (P + 6, 2) cross-covariance of camera parameters and mean motion of the boards with the terms; in a rig
        (G, 2), of all unknowns of its covariance.
    """

    terms: FloatArray
    covariance: FloatArray
    with_frame: FloatArray

    def __post_init__(self) -> None:
        keep_arrays(self, terms=(PUPIL_TERMS,), covariance=(PUPIL_TERMS, PUPIL_TERMS), with_frame=(None, PUPIL_TERMS))

    @classmethod
    def split(cls, terms: FloatArray, joint: FloatArray) -> tuple[FloatArray, Self]:
        """Return the covariance (P + 6, P + 6) of camera and mean motion, and the pupil, from the joint covariance
        (P + 2 + 6) in the order camera, pupil, motion."""
        frame, own = _places(len(joint) - PUPIL_TERMS)
        return joint[np.ix_(frame, frame)], cls(terms, joint[np.ix_(own, own)], joint[np.ix_(frame, own)])

    def joint(self, frame_covariance: FloatArray) -> FloatArray:
        """Return the joint covariance (P + 2 + 6) in the order camera, pupil, motion: the inverse of `split`."""
        frame, own = _places(len(frame_covariance))
        out = np.empty((len(frame) + PUPIL_TERMS,) * 2)
        out[np.ix_(frame, frame)], out[np.ix_(own, own)] = frame_covariance, self.covariance
        out[np.ix_(frame, own)] = self.with_frame
        out[np.ix_(own, frame)] = self.with_frame.T
        return out

    def shift_mm(self, theta_rad: float) -> tuple[float, float]:
        """Return the forward movement of the pupil at an angle from the axis, and its standard deviation (not widened),
        mm."""
        by_terms = theta_rad ** np.array([2.0, 4.0])
        mm = float(pupil_shift_mm(np.array(theta_rad), self.terms))
        return mm, float(np.sqrt(max(float(by_terms @ self.covariance @ by_terms), 0.0)))


def without_pupil(camera: Camera, joint: FloatArray) -> tuple[Camera, FloatArray, SolvedPupil | None]:
    """Return the central camera, the covariance (P + 6, P + 6) of its parameters and the boards' mean motion, and the
    pupil (None for a central lens), from a `near` camera and the `joint` covariance."""
    if not isinstance(camera, NearCamera):
        return camera, joint, None
    return camera.lens, *SolvedPupil.split(camera.pupil, joint)


def require_of_frame(pupil: SolvedPupil | None, frame: int) -> None:
    """Raise InputError unless the pupil's `with_frame` has `frame` rows."""
    if pupil is not None and len(pupil.with_frame) != frame:
        raise InputError(f"pupil: with_frame must have {frame} rows, has {len(pupil.with_frame)}; calibrate again")


def _places(frame: int) -> tuple[IntArray, IntArray]:
    """Return the indices of camera and motion, `frame` numbers, and those of the pupil in a joint covariance."""
    p = frame - 6
    own = p + np.arange(PUPIL_TERMS)
    return np.append(np.arange(p), own[-1] + 1 + np.arange(6)), own
