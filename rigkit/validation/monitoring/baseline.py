"""Changes since a calibration was trusted: images of that time correct it, and fresh ones are tested against it.

theta are the parameters, C their covariance, and e the error of the calibration. The earlier images have the whitened
score w = L^T e + noise (`whitened`). theta is corrected by e = G w, G = C L (I + L^T C L)^-1, and keeps the
covariance G G^T + (I - G L^T) C (I - G L^T)^T. A calibration file may have larger errors than C states, so C is first
multiplied by w^T (I + L^T C L)^-1 w - R, at least 1, with R scores: it then covers the error in every direction. Points
of one frame share errors of lens and scene, so frames may disagree by more than their points predict: the variance is
inflated by the disagreement among the earlier and among the fresh frames.

Reference: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001),
section 5.2.3 (the gain, and the Joseph form of the covariance, which stays positive semidefinite).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from rigkit.core.errors import InputError
from rigkit.planning.goal import Goal
from rigkit.validation.monitoring.evidence import FreshEvidence, Monitored
from rigkit.validation.monitoring.verdict import (
    Baseline,
    CalibrationCheck,
    Look,
    evaluate_evidence,
    exceeds_expected,
    unchanged_px,
)
from rigkit.validation.monitoring.whitened import Whitened, disagreement

CORRECTIONS = 4
"""Gauss-Newton iterations of the correction: published lenses are off by up to 2 px."""


def check_since(monitored: Monitored, before: Look, look: Look, cost: Sequence[Goal] = ()) -> CalibrationCheck:
    """Return the verdict on the evidence of fresh frames, `look`, against the cameras corrected by the evidence of
    frames from the time when they were trusted, `before`.

    Raises InputError where the earlier frames do not fit the cameras even after the correction.
    """
    trusted, now, change, chance = monitored, monitored, np.zeros(monitored.layout.count), 1.0
    first = evidence = before(monitored)
    for k in range(CORRECTIONS):
        evidence = before(now)
        wider = _Disagreement.of(evidence, look(now))
        whitened = Whitened.of(trusted, wider.of_frames(evidence))
        if k == 0:
            score = whitened.score
            squares = float(score @ np.linalg.solve(whitened.covariance, score))
            chance = float(fdtrc(len(score), whitened.freedom, squares / len(score)))
            trusted = replace(monitored, covariance=max(squares - len(score), 1.0) * monitored.covariance)
            whitened = Whitened.of(trusted, wider.of_frames(evidence))
        gain = np.linalg.solve(whitened.covariance, whitened.by_theta @ trusted.covariance).T
        change = gain @ (whitened.score + whitened.by_theta @ change)
        now = monitored.changed(change)
    left = np.eye(len(change)) - gain @ whitened.by_theta
    corrected = replace(now, covariance=gain @ gain.T + left @ trusted.covariance @ left.T)
    left_px, expected_px = before(corrected).rms_px, unchanged_px(corrected, first)
    if exceeds_expected(left_px, expected_px):
        raise InputError(
            f"check: the images of --before do not fit: {left_px:.2f} px rms remain once the calibration is corrected "
            f"to them, {expected_px:.2f} px are expected; give images of these cameras, of a rig simultaneous ones"
        )
    check = evaluate_evidence(corrected, lambda now: wider.of_frames(look(now)), cost)
    return replace(check, baseline=Baseline(len(first.score), first.rms_px, left_px, chance))


@dataclass(frozen=True, slots=True)
class _Disagreement:
    """Variance of the scores of frames over that predicted from their points, and its degrees of freedom."""

    ratio: float
    freedom: float

    @classmethod
    def of(cls, *times: FreshEvidence) -> _Disagreement:
        """Return that within each of several times; changes between the times do not count."""
        count, frames = times[0].score.shape[1], np.cumsum([0, *(len(evidence.score) for evidence in times)])
        information = np.zeros((frames[-1], len(times) * count, len(times) * count))
        score = np.zeros(information.shape[:2])
        for k, evidence in enumerate(times):
            of, own = slice(frames[k], frames[k + 1]), slice(k * count, (k + 1) * count)
            information[of, own, own] = evidence.information / evidence.variance_px2
            score[of, own] = evidence.score / evidence.variance_px2
        return cls(*disagreement(information, score))

    def of_frames(self, evidence: FreshEvidence) -> FreshEvidence:
        """Return the evidence with its variance inflated by the ratio."""
        if self.ratio <= 1.0:
            return evidence
        return replace(
            evidence,
            variance_px2=self.ratio * evidence.variance_px2,
            overdispersion=float(np.sqrt(self.ratio)) * evidence.overdispersion,
            freedom=min(self.freedom, evidence.freedom),
        )
