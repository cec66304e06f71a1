"""What a lens's series leaves out: the terms after its last.

Polynomials of the radius or of the angle are the first terms of a series. Boards in the middle of an image bear out as
few terms as show the middle; the next one may be thousandths of a pixel there, and pixels beyond them. No residual
tells of it, but the terms that there are do: let F_n(pixel) be by how far the last term moves the projection where all
other parameters follow as the images make them, F_(n-1) the same of the term before it. A series that falls by as much
with each further term leaves out

    sum_k a_k F_n q^k,    q = min(1, |F_n| / |F_(n-1)|) at each pixel,    a_k ~ N(0, 1),

next to nothing where boards were. A term counts as far as it is there: its value squared, less its variance. What the
images say of the a_k is counted in, as with other departures of a lens from its model.

Reference: R. J. Furnstahl, N. Klco, D. R. Phillips, S. Wesolowski, "Quantifying truncation errors in effective field
theory", Phys. Rev. C 92, 024005 (2015): a series is cut off with an error of the size of the term left out, which those
kept tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.departures import amounts_of
from rigkit.calibration.result import Calibration
from rigkit.core.arrays import FloatArray

TERMS, LEFT_OUT = 2, 3
"""So many terms tell how a series falls, and so many after the last are counted: of a series that falls to two thirds
with each term, 95 % of the squares of all."""


@dataclass(frozen=True, eq=False, slots=True)
class Remainder:
    """The terms that the series of a lens leaves out.

    Attributes
    ----------
    last, before : (P + 3,) how parameters move with the last term, and with that before it, and the rotation that hides
        it best where boards were.
    amounts : (LEFT_OUT, LEFT_OUT) independent sums of the terms left out, one standard deviation each.
    """

    last: FloatArray
    before: FloatArray
    amounts: FloatArray

    @classmethod
    def of(cls, calibration: Calibration, covariance: FloatArray, hides: FloatArray) -> Remainder | None:
        """Return that of a calibrated lens whose parameters have the `covariance` (P, P); `hides` (3, P) are the
        rotations that hide a step of each where boards were. None where the lens is no series, or its last term is not
        there."""
        terms = calibration.camera.series[-TERMS:][::-1]
        if len(terms) < TERMS:
            return None
        left, value, steps = covariance.copy(), calibration.camera.parameters.copy(), []
        for term in terms:
            variance, size = float(left[term, term]), float(value[term])
            if variance <= 0.0:
                return None
            # By how much each parameter goes with this one.
            along = left[:, term] / variance
            step = along * np.sign(size) * np.sqrt(max(size * size - variance, 0.0))
            steps.append(np.concatenate([step, -hides @ step]))
            left -= np.outer(along, left[term])
            value -= along * size
        if not steps[0].any():
            return None
        last, before = steps
        values, axes = np.linalg.eigh(amounts_of(calibration, lambda design: _left_out(design, last, before)))
        return cls(last, before, (axes * np.sqrt(np.maximum(values, 0.0))).T)

    def away(self, design: FloatArray) -> FloatArray:
        """Return by how far (LEFT_OUT, M, 2) px its parts move the projection, one standard deviation each; `design`
        (2, P + 3, M) are the derivatives by parameters and turns."""
        return np.asarray(np.einsum("kj,ijm->kmi", self.amounts, _left_out(design, self.last, self.before)))


def _left_out(design: FloatArray, last: FloatArray, before: FloatArray) -> FloatArray:
    """Return the terms that a series leaves out (2, LEFT_OUT, M), from its two last ones."""
    moved, larger = (np.einsum("ipm,p->im", design, step) for step in (last, before))
    size, whole = np.linalg.norm(moved, axis=0), np.linalg.norm(larger, axis=0)
    falls = np.divide(size, whole, out=np.ones_like(size), where=whole > size)
    return np.asarray(moved[:, None] * falls ** np.arange(1, LEFT_OUT + 1)[:, None])
