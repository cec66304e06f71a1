"""The power of a check: the probability that a change raises the alarm, and the number of frames that it needs.

Amounts a of a hypothesis with the normal matrix N in whitened scores give the F statistic the noncentrality a^T N a.
The critical value is that for one of all hypotheses tested (Bonferroni), and only the hypothesis of the change itself
is counted: the stated power is a lower estimate. More fresh frames do not reduce the covariance of the calibration:
where no number of them is enough, the calibration is too uncertain.

Reference: G. A. F. Seber, A. J. Lee, "Linear Regression Analysis" (2003), section 4.3.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chndtr, fdtri, gammaincinv

from rigkit.core.arrays import FloatArray
from rigkit.validation.monitoring.evidence import FreshEvidence, Monitored
from rigkit.validation.monitoring.hypotheses import Hypothesis, lens_goals
from rigkit.validation.monitoring.whitened import NULL_RANK, Whitened

LENS_KINDS = ("focus", "principal point", "distortion")
CHANGED_PX, TURNED_DEG = 0.15, 0.02
"""Changes of which the power is stated: of a lens, rms over the image after the best rotation; of a mount."""
FOUND = 0.9
"""Power from which a change counts as detectable."""
TIMES = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20)
"""Multiples of the number of frames that are tried."""
SIZE_PARTS = np.geomspace(1e-2, 1e2, 33)
"""Sizes at which the power is computed, as multiples of the stated size."""
MAX_NONCENTRALITY = 1e5
"""Beyond it the power is 1."""
QUANTILES = (np.arange(16) + 0.5) / 16
"""Of the distribution of the true variance, given its degrees of freedom."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Power:
    """How well a check detects a change.

    Attributes
    ----------
    kind, camera : of the hypothesis.
    size, unit : size of the change (px rms over the image, or degrees of a mount).
    chance : probability that it is detected, averaged over directions.
    found_from : the size detected with probability 0.9; infinite where these frames do not show it.
    frames : number of such frames that detect `size` with probability 0.9; None where the calibration is too uncertain.
    both : multiple of the frames, in the calibration as in the check, that detects it; None where not enough.
    """

    kind: str
    camera: str | None
    size: float
    unit: str
    chance: float
    found_from: float
    frames: int | None
    both: int | None


def powers_of(
    monitored: Monitored, evidence: FreshEvidence, hypotheses: Iterable[Hypothesis], alarm_chance: float
) -> tuple[Power, ...]:
    """Return the power of a check with frames like these for changes of each lens and rotations of mounts, where the
    alarm level `alarm_chance` is that of all hypotheses together."""
    hypotheses = list(hypotheses)
    several = [Whitened.of(monitored, _repeated(evidence, times)) for times in TIMES]
    more_precise = [
        Whitened.of(replace(monitored, covariance=monitored.covariance / times), _repeated(evidence, times))
        for times in TIMES
    ]
    goals = dict(zip(monitored.names, lens_goals(monitored), strict=True))
    out = []
    for hypothesis in hypotheses:
        if hypothesis.kind in LENS_KINDS:
            weight = goals[hypothesis.camera or monitored.names[0]].weight
            metric, size, unit = hypothesis.directions.T @ weight @ hypothesis.directions, CHANGED_PX, "px"
        elif hypothesis.kind == "rotation":
            metric, size, unit = np.eye(3), TURNED_DEG, "deg"
        else:
            continue
        alone = alarm_chance / len(hypotheses)
        now = _DetectionPower.of(several[0], hypothesis, metric, alone)
        enough, both = (
            next((t for t, w in w_of if _DetectionPower.of(w, hypothesis, metric, alone).is_detectable(size)), None)
            for w_of in (zip(TIMES, several, strict=True), zip(TIMES, more_precise, strict=True))
        )
        out.append(
            Power(
                kind=hypothesis.kind,
                camera=hypothesis.camera,
                size=size,
                unit=unit,
                chance=float(now.chance(np.array([size]))[0]),
                found_from=now.found_from(size),
                frames=None if enough is None else enough * len(evidence.score),
                both=both,
            )
        )
    return tuple(out)


def _repeated(evidence: FreshEvidence, times: int) -> FreshEvidence:
    return replace(evidence, information=times * evidence.information, score=times * evidence.score)


@dataclass(frozen=True, eq=False, slots=True)
class _DetectionPower:
    """Noncentrality of a change of unit size along each observable axis, the number of `amounts`, and the critical
    values (K,) of chi-squared for the quantiles of the variance."""

    by_axis: FloatArray
    amounts: int
    limits: FloatArray

    @classmethod
    def of(cls, whitened: Whitened, hypothesis: Hypothesis, metric: FloatArray, alarm_chance: float) -> _DetectionPower:
        by_amount = whitened.by_theta @ hypothesis.directions
        normal = by_amount.T @ np.linalg.solve(whitened.covariance, by_amount)
        size, axes = np.linalg.eigh(metric)
        seen = size > NULL_RANK * size[-1]
        root = axes[:, seen] / np.sqrt(size[seen])
        by_axis = np.maximum(np.linalg.eigvalsh(root.T @ normal @ root), 0.0)
        m = len(metric)
        limit = m * fdtri(m, whitened.freedom, 1.0 - alarm_chance)
        # Quantiles of chi-squared with these degrees of freedom; importing scipy.stats would take a second.
        chi2 = 2.0 * gammaincinv(0.5 * whitened.freedom, QUANTILES)
        return cls(by_axis, m, limit * chi2 / whitened.freedom)

    def chance(self, size: FloatArray) -> FloatArray:
        """Return the probability that changes of `size` (K,) are detected, averaged over their axes, (K,)."""
        noncentrality = np.minimum(self.by_axis * np.square(size)[:, None], MAX_NONCENTRALITY)
        return np.asarray(1.0 - chndtr(self.limits, self.amounts, noncentrality[..., None]).mean(axis=(1, 2)))

    def is_detectable(self, size: float) -> bool:
        """Say whether a change of `size` is detectable."""
        return bool(self.chance(np.array([size]))[0] >= FOUND)

    def found_from(self, size: float) -> float:
        """Return the smallest detectable size, searched around `size`; infinite where there is none."""
        found = self.chance(size * SIZE_PARTS)
        if found[-1] < FOUND:
            return float("inf")
        return size * float(np.exp(np.interp(FOUND, found, np.log(SIZE_PARTS))))
