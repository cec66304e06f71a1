"""Scores of fresh frames in units of their own scatter, and what unchanged cameras would show.

A = L L^T is the frames' information over their variance, and C the covariance of theta. Where nothing changed, w = L^+
score has the covariance I + L^T C L: the frames scatter, and the calibration was a little off from the start. A change
d of theta moves it by L^T d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.solving.clustered import effective_freedom
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import DegenerateError
from rigkit.validation.sentinel.evidence import FreshEvidence, Monitored

COMMON_FREEDOM = 10.0
"""By how much more images disagree than independent corners would is one number, the mean over all directions: lens and
board bend in some ways more than in others. Where measured, the variances of directions scatter around their mean by
about half of it, as a mean square of so many values does."""
NULL_RANK = 1e-9
MIN_FREE_VARIANCE = 1e-3
"""Of the variance of a match, what the fit leaves at least."""
MAX_CONDITION_NUMBER = 1e15
"""Of a covariance that rounding leaves something of."""


@dataclass(frozen=True, eq=False, slots=True)
class Whitened:
    """Scores w (R,), their covariance (R, R) where nothing changed, and how a change of theta moves them (R, T)."""

    score: FloatArray
    covariance: FloatArray
    by_theta: FloatArray
    freedom: float

    @classmethod
    def of(cls, monitored: Monitored, evidence: FreshEvidence) -> Whitened:
        information = evidence.information.sum(axis=0) / evidence.variance_px2
        score = evidence.score.sum(axis=0) / evidence.variance_px2
        # Scaled to a unit diagonal: parameters differ by many powers of ten.
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = information * scale[:, None] * scale
        if not np.isfinite(scaled).all():
            raise DegenerateError(
                "check: the pictures and the lens do not go together; check the calibration's numbers"
            )
        values, vectors = np.linalg.eigh(scaled)
        seen = values > NULL_RANK * values[-1]
        root = np.sqrt(values[seen])
        left = vectors[:, seen] * root / scale[:, None]
        own = (vectors[:, seen] * scale[:, None]).T @ score / root
        covariance = np.eye(len(own)) + left.T @ monitored.covariance @ left
        if not len(own) or np.linalg.cond(covariance) > MAX_CONDITION_NUMBER:
            raise DegenerateError(
                "check: beside these pictures, what the calibration says of its own numbers is worth nothing (its "
                "covariance, or the lens); calibrate again"
            )
        freedom = min(
            effective_freedom(known.freedom, known.overdispersion, len(own), COMMON_FREEDOM)
            for known in (monitored, evidence)
        )
        return cls(own, covariance, left.T, freedom)


def disagreement(information: FloatArray, score: FloatArray) -> tuple[float, float]:
    """Return by how much more the parts (K, T, T), (K, T) of an image scatter than independent matches would, as a
    ratio of variances, at least 1, and its degrees of freedom; what all have in common is left out."""
    whole = information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(whole * scale[:, None] * scale)
    seen = values > NULL_RANK * values[-1]
    root = vectors[:, seen] * scale[:, None] / np.sqrt(values[seen])
    common = root @ (root.T @ score.sum(axis=0))
    left = (score - information @ common) @ root
    # What all have in common follows each part by its share: what is left of part k and l has the covariance
    # (k == l) B_k - B_k B_l with B the shares. The sum of its squares counts as so many values (Satterthwaite).
    shares = root.T @ information @ root
    squares = shares @ shares
    common = squares.sum(axis=0)
    expected = max(root.shape[1] - float(np.trace(common)), MIN_FREE_VARIANCE)
    spread = float(np.trace(common) - 2.0 * (squares * shares).sum() + (common**2).sum())
    freedom = max(expected**2 / max(spread, MIN_FREE_VARIANCE), 1.0)
    return float(max(1.0, (left**2).sum() / expected)), freedom
