"""How the entrance pupil of a calibrated lens moves, and how sure that is."""

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
    """A pupil that moves by s(t) = e1 t^2 + e2 t^4, mm along the optical axis, at the angle t from it.

    Attributes
    ----------
    terms : (2,) e1 and e2, mm rad^-2 and mm rad^-4.
    covariance : (2, 2) of them, Student's like that of the camera's parameters.
    with_frame : (P + 6, 2) their covariance with the camera's parameters and the mean motion of the boards; of a rig
        (G, 2) with all that its covariance is of.
    """

    terms: FloatArray
    covariance: FloatArray
    with_frame: FloatArray

    def __post_init__(self) -> None:
        keep_arrays(self, terms=(PUPIL_TERMS,), covariance=(PUPIL_TERMS, PUPIL_TERMS), with_frame=(None, PUPIL_TERMS))

    @classmethod
    def split(cls, terms: FloatArray, joint: FloatArray) -> tuple[FloatArray, Self]:
        """Return the covariance (P + 6, P + 6) of the camera and the boards' mean motion, and the pupil, from that of
        all (P + 2 + 6), in the order camera, pupil, motion."""
        frame, own = _places(len(joint) - PUPIL_TERMS)
        return joint[np.ix_(frame, frame)], cls(terms, joint[np.ix_(own, own)], joint[np.ix_(frame, own)])

    def joint(self, frame_covariance: FloatArray) -> FloatArray:
        """Return the covariance (P + 2 + 6) of all, in the order camera, pupil, motion."""
        frame, own = _places(len(frame_covariance))
        out = np.empty((len(frame) + PUPIL_TERMS,) * 2)
        out[np.ix_(frame, frame)], out[np.ix_(own, own)] = frame_covariance, self.covariance
        out[np.ix_(frame, own)] = self.with_frame
        out[np.ix_(own, frame)] = self.with_frame.T
        return out

    def shift_mm(self, theta_rad: float) -> tuple[float, float]:
        """Return how far the pupil has moved forwards at an angle from the axis, and the standard deviation of that,
        not widened, mm."""
        by_terms = theta_rad ** np.array([2.0, 4.0])
        mm = float(pupil_shift_mm(np.array(theta_rad), self.terms))
        return mm, float(np.sqrt(max(float(by_terms @ self.covariance @ by_terms), 0.0)))

    def chance(self, freedom: float) -> float:
        """Return the probability of so large a movement where the pupil does not move; `freedom` degrees of freedom
        has the covariance."""
        # Imported here: scipy is slow to import, and few lenses ask.
        from scipy.special import fdtrc

        size = float(self.terms @ np.linalg.pinv(self.covariance, hermitian=True) @ self.terms) / PUPIL_TERMS
        return float(fdtrc(PUPIL_TERMS, min(freedom, 1e9), size))


def without_pupil(camera: Camera, joint: FloatArray) -> tuple[Camera, FloatArray, SolvedPupil | None]:
    """Return the central camera of a camera of points in mm, the covariance of its parameters and of the boards' mean
    motion, from that of all, `joint`, and the pupil where one moves."""
    if not isinstance(camera, NearCamera):
        return camera, joint, None
    return camera.lens, *SolvedPupil.split(camera.pupil, joint)


def require_of_frame(pupil: SolvedPupil | None, frame: int) -> None:
    """Raise InputError where a pupil's `with_frame` does not have `frame` rows."""
    if pupil is not None and len(pupil.with_frame) != frame:
        raise InputError(f"pupil: with_frame must have {frame} rows, has {len(pupil.with_frame)}; calibrate again")


def _places(frame: int) -> tuple[IntArray, IntArray]:
    """Return where camera and motion, `frame` numbers, and the pupil stand among all."""
    p = frame - 6
    own = p + np.arange(PUPIL_TERMS)
    return np.append(np.arange(p), own[-1] + 1 + np.arange(6)), own
