"""What fresh frames would have found: the chance that a change raises the alarm, and how many frames it takes.

A change a of a hypothesis adds a^T N a, N its normal matrix in whitened scores, to the mean of the statistic: F becomes
the noncentral F distribution. The limit is that of one of all hypotheses tried (Bonferroni), and a change is looked for
by its own hypothesis only: the chances stated are rather too small. The covariance of the calibration does not shrink
with the fresh frames: where no number of them is enough, the calibration is what is not sure.

Reference: G. A. F. Seber, A. J. Lee, "Linear Regression Analysis" (2003), section 4.3.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chndtr, fdtri, gammaincinv

from rigkit.core.arrays import FloatArray
from rigkit.validation.sentinel.evidence import FreshEvidence, Monitored
from rigkit.validation.sentinel.hypotheses import Hypothesis, lens_goals
from rigkit.validation.sentinel.whitened import NULL_RANK, Whitened

LENS_KINDS = ("focus", "principal point", "distortion")
CHANGED_PX, TURNED_DEG = 0.15, 0.02
"""Changes of which the chance is told: of a lens, rms over the image after the best rotation; of a mount."""
FOUND = 0.9
"""A change that is found so often is said to be found."""
TIMES = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20)
"""Frames like these that are thought of: so many times as many."""
SIZE_PARTS = np.geomspace(1e-2, 1e2, 33)
"""Sizes that are looked at, as parts of the one told of."""
MAX_NONCENTRALITY = 1e5
"""With it everything is found."""
QUANTILES = (np.arange(16) + 0.5) / 16
"""Of what the variance may be, given how well it is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Power:
    """How well a change would have been seen.

    Attributes
    ----------
    kind, camera : of the hypothesis.
    size, unit : a change of this size (px rms over the image, or degrees of a mount)
    chance : is found with this probability, in a direction as any other.
    found_from : the size that is found nine times in ten; infinite where these frames do not show it.
    frames : like these that find `size` nine times in ten; None where no number does: the calibration is not sure.
    both : so many times as many frames, in the calibration as in the check, find it; None where that is not enough.
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
    """Return how well changes of each lens, and turns of mounts, would have been seen by frames like these, where a
    chance below `alarm_chance` of any of the hypotheses is an alarm."""
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
        now = _Shown.of(several[0], hypothesis, metric, alone)
        enough, both = (
            next(
                (
                    t
                    for t, w in zip(TIMES, hypothetical, strict=True)
                    if _Shown.of(w, hypothesis, metric, alone).finds(size)
                ),
                None,
            )
            for hypothetical in (several, more_precise)
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
class _Shown:
    """Noncentrality of a change of unit size along each axis on which it moves anything, how many `amounts` it has, and
    the limits (K,) of chi-squared for what the variance may be."""

    by_axis: FloatArray
    amounts: int
    limits: FloatArray

    @classmethod
    def of(cls, whitened: Whitened, hypothesis: Hypothesis, metric: FloatArray, alarm_chance: float) -> _Shown:
        by_amount = whitened.by_theta @ hypothesis.directions
        normal = by_amount.T @ np.linalg.solve(whitened.covariance, by_amount)
        size, axes = np.linalg.eigh(metric)
        seen = size > NULL_RANK * size[-1]
        root = axes[:, seen] / np.sqrt(size[seen])
        by_axis = np.maximum(np.linalg.eigvalsh(root.T @ normal @ root), 0.0)
        m = len(metric)
        limit = m * fdtri(m, whitened.freedom, 1.0 - alarm_chance)
        # Of chi-squared with these degrees of freedom; scipy.stats has it too, but takes a second to import.
        chi2 = 2.0 * gammaincinv(0.5 * whitened.freedom, QUANTILES)
        return cls(by_axis, m, limit * chi2 / whitened.freedom)

    def chance(self, size: FloatArray) -> FloatArray:
        """Return how often changes of `size` (K,) are found, the mean over their axes, (K,)."""
        noncentrality = np.minimum(self.by_axis * np.square(size)[:, None], MAX_NONCENTRALITY)
        return np.asarray(1.0 - chndtr(self.limits, self.amounts, noncentrality[..., None]).mean(axis=(1, 2)))

    def finds(self, size: float) -> bool:
        """Say whether a change of `size` is found often enough."""
        return bool(self.chance(np.array([size]))[0] >= FOUND)

    def found_from(self, size: float) -> float:
        """Return the size that is found often enough, to be looked for around `size`; infinite where none is."""
        found = self.chance(size * SIZE_PARTS)
        if found[-1] < FOUND:
            return float("inf")
        return size * float(np.exp(np.interp(FOUND, found, np.log(SIZE_PARTS))))
