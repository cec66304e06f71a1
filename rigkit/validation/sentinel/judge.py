"""Whether a calibration still holds, and else what changed: fresh frames against its covariance.

Scores of frames have, where nothing changed, the covariance A + A C A in units of the frames' own scatter, with A their
information and C the covariance of theta: the frames scatter, and the calibration was a little off from the start. With
A = L L^T, w = L^+ score has the covariance I + L^T C L, and a change theta += D a moves it by L^T D a. Every hypothesis
D is fitted alone; the simplest that explains enough is named (Schwarz's criterion), and the chance that unchanged
cameras show as much of any hypothesis is that of the smallest chance of F-tests, drawn or by Bonferroni's bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.special import fdtrc

from rigkit.calibration.solving.clustered import LARGE_FREEDOM
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import DegenerateError
from rigkit.planning.goal import Goal
from rigkit.validation.sentinel.evidence import FreshEvidence, FreshView, Monitored, evidence_of
from rigkit.validation.sentinel.hypotheses import Hypothesis, hypotheses_of, lens_goals, turn_weight
from rigkit.validation.sentinel.power import Power, powers_of
from rigkit.validation.sentinel.whitened import NULL_RANK, Whitened

Look: TypeAlias = Callable[[Monitored], FreshEvidence]
"""What fresh frames say, given cameras and mounts."""

ALARM_CHANCE = 0.01
"""Fresh pictures that unchanged cameras would show more rarely raise an alarm."""
ALARM_PX = 0.07
"""What moves the projection by less is of no importance, however surely it is there."""
FIX_ROUNDS = 3
"""Times that a change is linearised anew where it was found."""
MAX_OF_EXPECTED = 3.0
"""Corners that scatter so many times as much as expected after every explanation are explained by none."""
MAX_SIGMA = 100.0
"""Percent, pixels, degrees, millimetres: what is known no better is not seen at all."""
RARE = {"lens": 6.0, "moved": 6.0}
"""Twice the log odds against several things at once: one time in twenty."""
RARE_IN_RIGS = {"principal point": 6.0}
"""Mounts turn, by what looks nearly the same, much more often than the glass moves in its barrel."""
AS_MUCH = 0.9
"""Of what the likeliest hypothesis explains, by derivatives where nothing changed: of a large change these are off by a
few per cent (a board with squares of 20 mm for 25: 0.7), and a simpler hypothesis that explains as much is held against
it at the end of its own change."""
DRAWS, FEW_DRAWS = 4000, 8
"""Of what unchanged cameras show; fewer than so many tell no chance."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Change:
    """A hypothesis with the amounts that explain the frames best.

    Attributes
    ----------
    hypothesis : what changed.
    amounts, covariance : (K,) and (K, K), in `hypothesis.units`.
    chance : probability that unchanged cameras show as much of it.
    size_px : how far it moves the projection, rms after the best rotation; of a mount, how far what it shows moves.
    max_px : the same with how unsure it is: what may be large is not small because it is told badly.
    gain : by how much it lowers the sum of squares.
    """

    hypothesis: Hypothesis
    amounts: FloatArray
    covariance: FloatArray
    chance: float
    size_px: float
    max_px: float
    gain: float

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the amounts."""
        return np.sqrt(np.diag(self.covariance))

    def __str__(self) -> str:
        if self.hypothesis.kind == "lens":
            # Its amounts make up for each other: each by itself would say far more than happened.
            return f"{self.hypothesis.words}: by {self.size_px:.2g} px rms in all"
        values = ", ".join(
            f"{a:+.3g} +- {s:.2g} {unit}"
            for a, s, unit in zip(self.amounts, self.sigmas, self.hypothesis.units, strict=True)
        )
        return f"{self.hypothesis.words}: {values}"


@dataclass(frozen=True, slots=True)
class Baseline:
    """What frames of the time when a calibration was trusted say of it.

    Attributes
    ----------
    frames : how many there were.
    rms_px, rms_corrected_px : how far their points lie from where it has them, as it is and once it is corrected.
    chance : probability that a calibration as sure as it says is off by so much.
    """

    frames: int
    rms_px: float
    rms_corrected_px: float
    chance: float


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class SentinelCheck:
    """The verdict on fresh pictures.

    Attributes
    ----------
    chance : probability that an unchanged camera or rig shows at least as much.
    change : what explains the pictures best, alarming or not; None where no hypothesis can be told.
    monitored, fixed : as calibrated, and after `change`.
    step, covariance : change of theta (T,), and its covariance (T, T).
    rms_px, rms_fixed_px : of the fresh corners before and after.
    expected_px : rms that corners of unchanged cameras show, with what the calibration leaves open.
    frames, corners : how many there were.
    tried : every hypothesis by itself, the simplest first.
    powers : how well changes of lenses and turns of mounts would have been seen; what is missing was not seen at all.
    cost : error that the change makes in the user's measurement (rms over the image), in `cost_unit`.
    flipped : how the pictures must have been flipped if nothing changed (`flipped_pictures`); "" where that is no
        explanation, or was not asked.
    baseline : what was wrong before; `monitored` is without it. None where fresh frames are held against the file.
    """

    chance: float
    change: Change | None
    monitored: Monitored
    fixed: Monitored
    step: FloatArray
    covariance: FloatArray
    rms_px: float
    rms_fixed_px: float
    expected_px: float
    frames: int
    corners: int
    tried: tuple[Change, ...] = ()
    powers: tuple[Power, ...] = ()
    cost: float = 0.0
    cost_unit: str = "px"
    flipped: str = ""
    baseline: Baseline | None = None

    @property
    def unexplained(self) -> bool:
        """Nothing that may happen to these cameras explains the pictures: another camera, or another board."""
        return exceeds_expected(self.rms_fixed_px, self.expected_px)

    @property
    def holds(self) -> bool:
        """Nothing says that the calibration does not hold."""
        if self.unexplained:
            return False
        return self.change is None or self.chance >= ALARM_CHANCE or self.change.max_px < ALARM_PX


def exceeds_expected(rms_px: float, expected_px: float) -> bool:
    """Say whether residuals are beyond all that is expected; those that are no numbers are."""
    return not rms_px <= max(MAX_OF_EXPECTED * expected_px, ALARM_PX)


def check_views(monitored: Monitored, views: Sequence[FreshView], cost: Sequence[Goal] = ()) -> SentinelCheck:
    """Return whether fresh views of boards agree with what is `monitored`; `cost` weighs a change of theta by what it
    does to a measurement (the worst of several), by default to the projection.

    Raises as `evidence_of`.
    """
    return evaluate_evidence(monitored, lambda now: evidence_of(now, views), cost)


def evaluate_evidence(monitored: Monitored, look: Look, cost: Sequence[Goal] = ()) -> SentinelCheck:
    """Return the verdict on what `look` finds in fresh frames."""
    evidence = look(monitored)
    expected_px, known, chance = unchanged_px(monitored, evidence), list[Change](), 1.0
    try:
        whitened = Whitened.of(monitored, evidence)
        known = [c for c in (_fitted(whitened, hypothesis) for hypothesis in hypotheses_of(monitored)) if c is not None]
    except DegenerateError:
        # Pictures of something else are far from all that can be linearised: that is the verdict.
        if not exceeds_expected(evidence.rms_px, expected_px):
            raise
        chance = 0.0
    step, covariance, change = np.zeros(monitored.layout.count), monitored.covariance, None
    fixed, after = monitored, evidence
    if known:
        chance = _chance_of_any(whitened, known)
        penalty = float(np.log(max(len(whitened.score), 3)))
        best = max(known, key=lambda c: _evident(c, penalty))
        amounts, fixed, after = _refined(monitored, look, best)
        for rival in sorted(known, key=lambda c: _cost(c, penalty)):
            if _cost(rival, penalty) >= _cost(best, penalty) or rival.gain < AS_MUCH * best.gain:
                continue
            other = _refined(monitored, look, rival)
            left = after.corners * (other[2].rms_px ** 2 - after.rms_px**2) / expected_px**2
            if left < _cost(best, penalty) - _cost(rival, penalty):
                best, (amounts, fixed, after) = rival, other
                break
        step = best.hypothesis.directions @ amounts
        unsure = best.hypothesis.directions @ best.covariance @ best.hypothesis.directions.T
        covariance = monitored.covariance + unsure
        size_px, max_px = _sizes_px(monitored, evidence, step, unsure)
        change = replace(best, amounts=amounts, size_px=size_px, max_px=max_px)
    goals = cost or lens_goals(monitored)
    return SentinelCheck(
        chance=chance,
        change=change,
        monitored=monitored,
        fixed=fixed,
        step=step,
        covariance=covariance,
        rms_px=evidence.rms_px,
        rms_fixed_px=after.rms_px,
        expected_px=expected_px,
        frames=len(evidence.score),
        corners=evidence.corners,
        tried=tuple(known),
        powers=()
        if exceeds_expected(after.rms_px, expected_px)
        else powers_of(monitored, evidence, [c.hypothesis for c in known], ALARM_CHANCE),
        cost=float(np.sqrt(max([0.0, *(float(step @ g.weight @ step) for g in goals)]))),
        cost_unit=goals[0].unit,
    )


def unchanged_px(monitored: Monitored, evidence: FreshEvidence) -> float:
    """Return the rms that corners of unchanged cameras show: their scatter, and what the calibration leaves open."""
    shown = evidence.information.sum(axis=0) / evidence.corners
    # Pictures of something else may be too far off for any derivative: they say nothing of that.
    with np.errstate(over="ignore", invalid="ignore"):
        left_open = float((shown * monitored.covariance).sum())
    return float(np.sqrt(evidence.expected_px**2 + (max(left_open, 0.0) if np.isfinite(left_open) else 0.0)))


def _chance_of_any(whitened: Whitened, known: Sequence[Change]) -> float:
    """Return the probability that unchanged cameras show as much of any hypothesis as they show of the likeliest.
    Hypotheses overlap, so that it is less than the sum of their chances: drawn, as long as draws tell; else
    Bonferroni's bound."""
    best = min(c.chance for c in known)
    bound = min(1.0, len(known) * best)
    if bound < FEW_DRAWS / DRAWS:
        return bound
    rng = np.random.default_rng(0)
    spread, axes = np.linalg.eigh(whitened.covariance)
    root = axes / np.sqrt(spread)
    drawn = rng.standard_normal((len(spread), DRAWS))
    scale = rng.chisquare(whitened.freedom, DRAWS) / whitened.freedom if whitened.freedom < LARGE_FREEDOM else 1.0
    least = np.ones(DRAWS)
    for change in known:
        basis = np.linalg.qr(root.T @ whitened.by_theta @ change.hypothesis.directions)[0]
        m = basis.shape[1]
        gain = ((basis.T @ drawn) ** 2).sum(axis=0) / scale
        least = np.minimum(least, fdtrc(m, whitened.freedom, gain / m))
    return float(min(bound, (1.0 + np.count_nonzero(least <= best)) / (DRAWS + 1.0)))


def _evident(change: Change, penalty: float) -> float:
    """Return twice the log odds of a hypothesis: what it explains, less what its numbers and its rarity cost."""
    return change.gain - _cost(change, penalty)


def _cost(change: Change, penalty: float) -> float:
    kind = change.hypothesis.kind
    rare = RARE.get(kind, 0.0) + (RARE_IN_RIGS.get(kind, 0.0) if change.hypothesis.camera is not None else 0.0)
    return change.amounts.size * penalty + rare


def _refined(monitored: Monitored, look: Look, change: Change) -> tuple[FloatArray, Monitored, FreshEvidence]:
    """Return the amounts of a change, what is watched after it, and what the frames say then: linearised anew there, as
    long as that is possible."""
    amounts = change.amounts
    fixed = monitored.changed(change.hypothesis.directions @ amounts)
    after = look(fixed)
    for _ in range(FIX_ROUNDS):
        try:
            again = _fitted(Whitened.of(fixed, after), change.hypothesis)
        except DegenerateError:
            again = None
        if again is None:
            break
        closer = monitored.changed(change.hypothesis.directions @ (amounts + again.amounts))
        try:
            then = look(closer)
        except DegenerateError:  # A step so wide that the lens sees nothing any more.
            break
        if then.rms_px > after.rms_px:
            break
        amounts, fixed, after = amounts + again.amounts, closer, then
    return amounts, fixed, after


def _fitted(whitened: Whitened, hypothesis: Hypothesis) -> Change | None:
    """Return what a hypothesis would have to be; None where the frames do not show it."""
    by_amount = whitened.by_theta @ hypothesis.directions
    weighed = np.linalg.solve(whitened.covariance, np.column_stack([by_amount, whitened.score]))
    normal, right = by_amount.T @ weighed[:, :-1], by_amount.T @ weighed[:, -1]
    size = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    if np.linalg.cond(normal / np.outer(size, size)) > 1.0 / NULL_RANK:
        return None
    covariance = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
    if np.diag(covariance).max() > MAX_SIGMA**2:
        return None
    amounts = covariance @ right
    gain = float(right @ amounts)
    m = len(amounts)
    chance = float(fdtrc(m, whitened.freedom, max(gain, 0.0) / m))
    return Change(
        hypothesis=hypothesis, amounts=amounts, covariance=covariance, chance=chance, size_px=0.0, max_px=0.0, gain=gain
    )


def _sizes_px(
    monitored: Monitored, evidence: FreshEvidence, step: FloatArray, unsure: FloatArray
) -> tuple[float, float]:
    """Return how large a change of theta (T,) is, whose estimate has the covariance `unsure`. It is the largest of:
    over the image of the camera that suffers most, after the best rotation; how far a camera that turned on its mount
    sees what is far away move; what the corners show of it. The square of an estimate is too large by its variance,
    which is taken off; and the same where it is not."""
    shown = evidence.information.sum(axis=0) / evidence.corners
    turns = [_turn_weight(monitored, c) for c in range(1, len(monitored.cameras))]
    weights = [shown, *(goal.weight for goal in lens_goals(monitored)), *turns]
    squares = np.array([(step @ weight @ step, (weight * unsure).sum()) for weight in weights])
    return float(np.sqrt(max(0.0, *(squares[:, 0] - squares[:, 1])))), float(np.sqrt(max(0.0, *squares[:, 0])))


def _turn_weight(monitored: Monitored, c: int) -> FloatArray:
    """Return what a turn of camera `c` in a change of theta moves, (T, T): see `turn_weight`."""
    layout = monitored.layout
    turn = layout.mount(c).start
    out = np.zeros((layout.count, layout.count))
    out[turn : turn + 3, turn : turn + 3] = turn_weight(monitored.cameras[c])
    return out
