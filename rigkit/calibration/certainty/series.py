"""Truncation error of a lens model that is a series: the terms after its last one.

Polynomials of the radius or of the angle are truncated series. Boards in the middle of an image support few terms; the
next one may be thousandths of a pixel there, and several pixels outside. No residual shows it, but the kept terms give
its size. Let F_n(pixel) be the displacement of the projection by the last term, with all other parameters refitted to
the images, and F_(n-1) that by the term before it. If the series decreases geometrically, the truncated terms are

    sum_k a_k F_n q^k,    q = min(1, |F_n| / |F_(n-1)|) at each pixel,    a_k ~ N(0, 1),

almost zero where boards were. The size of a term is its value squared less its variance. The a_k are estimated from the
images like other departures of a lens from its model.

Reference: R. J. Furnstahl, N. Klco, D. R. Phillips, S. Wesolowski, "Quantifying truncation errors in effective field
theory", Phys. Rev. C 92, 024005 (2015): the truncation error has the size of the first omitted term, which the kept
terms predict.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.departures import amounts_of
from rigkit.calibration.result import Calibration
from rigkit.core.arrays import FloatArray

TERMS, LEFT_OUT = 2, 3
"""Number of terms that give the ratio of the series, and number of truncated terms included: 95 % of their squares for
a ratio of two thirds."""


@dataclass(frozen=True, eq=False, slots=True)
class Remainder:
    """The truncated terms of the series of a lens.

    Attributes
    ----------
    last, before : (P + 3,) change of the parameters with the last term and with the one before it, and the rotation
        that compensates it best where boards were.
    amounts : (LEFT_OUT, LEFT_OUT) rows are independent combinations of the truncated terms, one standard deviation
        each.
    """

    last: FloatArray
    before: FloatArray
    amounts: FloatArray

    @classmethod
    def of(cls, calibration: Calibration, covariance: FloatArray, compensation: FloatArray) -> Remainder | None:
        """Return that of a calibrated lens with the `covariance` (P, P) of its parameters; `compensation` (3, P) are
        the rotations that compensate a step of each best where boards were. None where the model is no series, or its
        last term is not significant."""
        terms = calibration.camera.series[-TERMS:][::-1]
        if len(terms) < TERMS:
            return None
        left, value, steps = covariance.copy(), calibration.camera.parameters.copy(), []
        for term in terms:
            variance, size = float(left[term, term]), float(value[term])
            if variance <= 0.0:
                return None
            # Regression of the parameters on this one.
            along = left[:, term] / variance
            step = along * np.sign(size) * np.sqrt(max(size * size - variance, 0.0))
            steps.append(np.concatenate([step, -compensation @ step]))
            left -= np.outer(along, left[term])
            value -= along * size
        if not steps[0].any():
            return None
        last, before = steps
        values, axes = np.linalg.eigh(amounts_of(calibration, lambda design: _left_out(design, last, before)))
        return cls(last, before, (axes * np.sqrt(np.maximum(values, 0.0))).T)

    def shifts_px(self, design: FloatArray) -> FloatArray:
        """Return the displacements (LEFT_OUT, M, 2) px of the projection by its independent parts, one standard
        deviation each; `design` (2, P + 3, M) are the derivatives by parameters and rotations."""
        return np.asarray(np.einsum("kj,ijm->kmi", self.amounts, _left_out(design, self.last, self.before)))


def _left_out(design: FloatArray, last: FloatArray, before: FloatArray) -> FloatArray:
    """Return the displacements (2, LEFT_OUT, M) by the truncated terms, from those by the last two."""
    moved, larger = (np.einsum("ipm,p->im", design, step) for step in (last, before))
    size, whole = np.linalg.norm(moved, axis=0), np.linalg.norm(larger, axis=0)
    falls = np.divide(size, whole, out=np.ones_like(size), where=whole > size)
    return np.asarray(moved[:, None] * falls ** np.arange(1, LEFT_OUT + 1)[:, None])
