"""Whitened scores of fresh frames, and their covariance for unchanged cameras.

A = L L^T is the frames' information over their variance, and C the covariance of theta. Where nothing changed,
w = L^+ score has the covariance I + L^T C L: the noise of the frames, and the error of the calibration. A change d of
theta moves it by L^T d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.solving.clustered import effective_freedom, root_of_inverse
from rigkit.core.arrays import FloatArray, root_diagonal
from rigkit.core.errors import DegenerateError
from rigkit.validation.monitoring.evidence import FreshEvidence, Monitored

COMMON_FREEDOM = 10.0
"""Degrees of freedom of one overdispersion for all directions: lens and board deform more in some directions than in
others. In the measured cases the variances of directions scatter around their mean by about half of it, as a mean
square of so many values does."""
NULL_RANK = 1e-9
MIN_FREE_VARIANCE = 1e-3
"""Smallest part of the variance of a match that a fit leaves."""
MAX_CONDITION_NUMBER = 1e15
"""Of a covariance that is not lost to rounding errors."""


@dataclass(frozen=True, eq=False, slots=True)
class Whitened:
    """Scores w (R,), their covariance (R, R) where nothing changed, and their derivatives by theta (R, T)."""

    score: FloatArray
    covariance: FloatArray
    by_theta: FloatArray
    freedom: float

    @classmethod
    def of(cls, monitored: Monitored, evidence: FreshEvidence) -> Whitened:
        information = evidence.information.sum(axis=0) / evidence.variance_px2
        score = evidence.score.sum(axis=0) / evidence.variance_px2
        # Scaled to a unit diagonal: parameters differ by many orders of magnitude.
        scale = 1.0 / root_diagonal(information)
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = information * scale[:, None] * scale
        if not np.isfinite(scaled).all():
            raise DegenerateError(
                "check: the derivatives of these images by the calibration's parameters are not finite; check "
                "the parameters in the calibration file"
            )
        values, vectors = np.linalg.eigh(scaled)
        seen = values > NULL_RANK * values[-1]
        root = np.sqrt(values[seen])
        left = vectors[:, seen] * root / scale[:, None]
        own = (vectors[:, seen] * scale[:, None]).T @ score / root
        covariance = np.eye(len(own)) + left.T @ monitored.covariance @ left
        if not len(own) or np.linalg.cond(covariance) > MAX_CONDITION_NUMBER:
            raise DegenerateError(
                "check: the calibration's covariance, or its lens, is implausible compared with these images; "
                "calibrate again"
            )
        freedom = min(
            effective_freedom(known.freedom, known.overdispersion, len(own), COMMON_FREEDOM)
            for known in (monitored, evidence)
        )
        return cls(own, covariance, left.T, freedom)


def disagreement(information: FloatArray, score: FloatArray) -> tuple[float, float]:
    """Return the variance of the parts (K, T, T), (K, T) of an image over that of independent matches, at least 1, and
    its degrees of freedom. The estimate common to all parts is subtracted first."""
    whole = information.sum(axis=0)
    root = root_of_inverse(whole, NULL_RANK)
    common = root @ (root.T @ score.sum(axis=0))
    left = (score - information @ common) @ root
    # The common estimate uses each part by its share B: the residuals of parts k and l have the covariance
    # (k == l) B_k - B_k B_l. The degrees of freedom of their sum of squares are by Satterthwaite.
    shares = root.T @ information @ root
    squares = shares @ shares
    common = squares.sum(axis=0)
    expected = max(root.shape[1] - float(np.trace(common)), MIN_FREE_VARIANCE)
    spread = float(np.trace(common) - 2.0 * (squares * shares).sum() + (common**2).sum())
    freedom = max(expected**2 / max(spread, MIN_FREE_VARIANCE), 1.0)
    return float(max(1.0, (left**2).sum() / expected)), freedom
