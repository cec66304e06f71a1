"""Whether a calibration still holds, and otherwise what changed: a test of fresh frames against its covariance.

Where nothing changed, the scores of frames have the covariance A + A C A, A their information over their variance and
C the covariance of theta: the noise of the frames, and the error of the calibration. With A = L L^T, w = L^+ score has
the covariance I + L^T C L, and a change theta += D a moves it by L^T D a. Every hypothesis D is fitted on its own. The
simplest that explains enough is reported (Schwarz's criterion, BIC). The p-value is the probability that, for unchanged
cameras, the smallest p-value of all hypotheses' F-tests is as small: by simulation or by Bonferroni's bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.special import fdtrc

from rigkit.calibration.solving.clustered import LARGE_FREEDOM, widening
from rigkit.core.arrays import FloatArray, root_diagonal
from rigkit.core.errors import DegenerateError, InputError
from rigkit.planning.goal import Goal
from rigkit.validation.monitoring.evidence import FreshEvidence, FreshView, Monitored, evidence_of
from rigkit.validation.monitoring.hypotheses import Hypothesis, hypotheses_of, lens_goals, turn_weight
from rigkit.validation.monitoring.power import Power, powers_of
from rigkit.validation.monitoring.whitened import NULL_RANK, Whitened

Look: TypeAlias = Callable[[Monitored], FreshEvidence]
"""The evidence of fresh frames as a function of cameras and mounts."""

ALARM_CHANCE = 0.01
"""p-values below raise an alarm."""
ALARM_PX = 0.07
"""Changes that move the projection by less raise no alarm, however significant."""
RANGE_HALVINGS = 10
"""Of a change that leaves the range of the lens model: a thousandth of it is none."""
FIX_ROUNDS = 3
"""Further Gauss-Newton iterations of a change."""
MAX_OF_EXPECTED = 3.0
"""Where residuals after every explanation exceed the expected ones by this factor, nothing explains them."""
MAX_SIGMA = 100.0
"""Percent, pixels, degrees, millimetres: amounts with larger standard deviations are not observable."""
RARE = {"lens": 6.0, "moved": 6.0}
"""Twice the log of the prior odds against several changes at once: one in twenty."""
RARE_IN_RIGS = {"principal point": 6.0}
"""Rotations of mounts look nearly the same, and are much more frequent than shifts of the principal point."""
AS_MUCH = 0.9
"""As a part of the gain of the best hypothesis, linearised where nothing changed. For large changes such gains are
wrong by a few per cent (a board with squares of 20 mm for 25: 0.7), so a simpler hypothesis with at least this part is
compared by its residuals after its own change."""
TESTS_DRAWN, FEW_DRAWS = 4000, 8
"""Simulated tests of unchanged cameras; fewer exceedances than FEW_DRAWS give no reliable p-value."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Change:
    """A hypothesis with the amounts that fit the frames best.

    Attributes
    ----------
    hypothesis : what changed.
    amounts, covariance : (K,) and (K, K), in `hypothesis.units`.
    freedom : degrees of freedom of the covariance.
    chance : p-value, from the F-test of this hypothesis.
    size_px : rms displacement of the projection after the best rotation; for a mount, of the points it shows.
    max_px : the same including the uncertainty of the amounts, so that a poorly known change is not taken as small.
    gain : reduction of the sum of squares.
    """

    hypothesis: Hypothesis
    amounts: FloatArray
    covariance: FloatArray
    freedom: float
    chance: float
    size_px: float
    max_px: float
    gain: float

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the amounts, widened for the degrees of freedom, as is `chance`: a single amount of
        two of them has the p-value of two of a normal distribution."""
        return np.asarray(widening(self.freedom) * np.sqrt(np.diag(self.covariance)))

    def __str__(self) -> str:
        if self.hypothesis.kind == "lens":
            # Its amounts are correlated and compensate each other: single ones would overstate the change.
            return f"{self.hypothesis.words}: by {self.size_px:.2g} px rms in all"
        return f"{self.hypothesis.words}: {self.amounts_with_sigmas()}"

    def amounts_with_sigmas(self) -> str:
        """Return all amounts with their standard deviations and units."""
        return ", ".join(
            f"{a:+.3g} ± {s:.2g} {unit}"
            for a, s, unit in zip(self.amounts, self.sigmas, self.hypothesis.units, strict=True)
        )


@dataclass(frozen=True, slots=True)
class Baseline:
    """The test of a calibration with frames from the time when it was trusted.

    Attributes
    ----------
    frames : number of frames.
    rms_px, rms_corrected_px : of the residuals before and after the correction.
    chance : p-value of errors of this size, given the covariance of the calibration.
    """

    frames: int
    rms_px: float
    rms_corrected_px: float
    chance: float


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CalibrationCheck:
    """The verdict on fresh images.

    Attributes
    ----------
    chance : p-value, the probability that an unchanged camera or rig shows at least as much.
    change : the best explanation of the images, significant or not; None where no hypothesis is observable.
    monitored, fixed : as calibrated, and after `change`.
    step, covariance : change of theta (T,), and covariance of the changed theta (T, T).
    rms_px, rms_fixed_px : of the fresh corners before and after.
    expected_px : expected rms for unchanged cameras, uncertainty of the calibration included.
    frames, corners : numbers of both.
    tried : every hypothesis on its own, the simplest first.
    powers : power of the test for changes of lenses and rotations of mounts; those missing are not observable.
    cost : error that the change causes in the user's measurement (rms over the image), in `cost_unit`.
    flipped : how the images must have been flipped if nothing changed (`flipped_pictures`); "" where that is no
        explanation, or was not tested.
    baseline : the correction from earlier frames, included in `monitored`; None without such frames.
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
        """Whether no hypothesis explains the images: another camera, or another board."""
        return exceeds_expected(self.rms_fixed_px, self.expected_px)

    @property
    def holds(self) -> bool:
        """Whether there is no evidence against the calibration."""
        if self.unexplained:
            return False
        return self.change is None or self.chance >= ALARM_CHANCE or self.change.max_px < ALARM_PX


def exceeds_expected(rms_px: float, expected_px: float) -> bool:
    """Say whether residuals are larger than expected; NaN counts as larger."""
    return not rms_px <= max(MAX_OF_EXPECTED * expected_px, ALARM_PX)


def check_views(monitored: Monitored, views: Sequence[FreshView], cost: Sequence[Goal] = ()) -> CalibrationCheck:
    """Return whether fresh views of boards agree with the `monitored` calibration. `cost` are quadratic forms of a
    change of theta: its effect on measurements (the largest is stated), by default on the projection.

    Raises as `evidence_of`.
    """
    return evaluate_evidence(monitored, lambda now: evidence_of(now, views), cost)


def evaluate_evidence(monitored: Monitored, look: Look, cost: Sequence[Goal] = ()) -> CalibrationCheck:
    """Return the verdict on the evidence of fresh frames, `look`."""
    evidence = look(monitored)
    expected_px, known, chance = unchanged_px(monitored, evidence), list[Change](), 1.0
    try:
        whitened = Whitened.of(monitored, evidence)
        known = [
            c
            for c in (_fit_hypothesis(whitened, hypothesis) for hypothesis in hypotheses_of(monitored))
            if c is not None
        ]
    except DegenerateError:
        # Images of something else are beyond any linearisation: the calibration does not hold for them.
        if not exceeds_expected(evidence.rms_px, expected_px):
            raise
        chance = 0.0
    step, covariance, change = np.zeros(monitored.layout.count), monitored.covariance, None
    fixed, after = monitored, evidence
    if known:
        chance = _family_wise_p_value(whitened, known)
        penalty = float(np.log(max(len(whitened.score), 3)))
        best = max(known, key=lambda c: _log_odds(c, penalty))
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
        step_covariance = best.hypothesis.directions @ best.covariance @ best.hypothesis.directions.T
        covariance = monitored.covariance + step_covariance
        size_px, max_px = _sizes_px(monitored, evidence, step, step_covariance)
        change = replace(best, amounts=amounts, size_px=size_px, max_px=max_px)
    goals = cost or lens_goals(monitored)
    # Goals are of lenses and mounts, which come first.
    moved = step[: len(goals[0].weight)]
    return CalibrationCheck(
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
        cost=float(np.sqrt(max([0.0, *(float(moved @ g.weight @ moved) for g in goals)]))),
        cost_unit=goals[0].unit,
    )


def unchanged_px(monitored: Monitored, evidence: FreshEvidence) -> float:
    """Return the rms residual expected for unchanged cameras: noise, and uncertainty of the calibration."""
    shown = evidence.information.sum(axis=0) / evidence.corners
    # Images of something else may be too far off for any derivative: only the noise is then counted.
    with np.errstate(over="ignore", invalid="ignore"):
        left_open = float((shown * monitored.covariance).sum())
    return float(np.sqrt(evidence.expected_px**2 + (max(left_open, 0.0) if np.isfinite(left_open) else 0.0)))


def _family_wise_p_value(whitened: Whitened, known: Sequence[Change]) -> float:
    """Return the probability that unchanged cameras give a p-value as small as the smallest of these, for any
    hypothesis. Hypotheses overlap, so it is below the sum of their p-values: simulated where enough draws exceed it,
    else Bonferroni's bound."""
    best = min(c.chance for c in known)
    bound = min(1.0, len(known) * best)
    if bound < FEW_DRAWS / TESTS_DRAWN:
        return bound
    rng = np.random.default_rng(0)
    spread, axes = np.linalg.eigh(whitened.covariance)
    root = axes / np.sqrt(spread)
    drawn = rng.standard_normal((len(spread), TESTS_DRAWN))
    scale = rng.chisquare(whitened.freedom, TESTS_DRAWN) / whitened.freedom if whitened.freedom < LARGE_FREEDOM else 1.0
    least = np.ones(TESTS_DRAWN)
    for change in known:
        basis = np.linalg.qr(root.T @ whitened.by_theta @ change.hypothesis.directions)[0]
        m = basis.shape[1]
        gain = ((basis.T @ drawn) ** 2).sum(axis=0) / scale
        least = np.minimum(least, fdtrc(m, whitened.freedom, gain / m))
    return float(min(bound, (1.0 + np.count_nonzero(least <= best)) / (TESTS_DRAWN + 1.0)))


def _log_odds(change: Change, penalty: float) -> float:
    """Return twice the log odds of a hypothesis: its gain, less the costs of its parameters and of its prior odds."""
    return change.gain - _cost(change, penalty)


def _cost(change: Change, penalty: float) -> float:
    kind = change.hypothesis.kind
    rare = RARE.get(kind, 0.0) + (RARE_IN_RIGS.get(kind, 0.0) if change.hypothesis.camera is not None else 0.0)
    return change.amounts.size * penalty + rare


def _as_far_as_the_model(monitored: Monitored, change: Change) -> tuple[FloatArray, Monitored]:
    """Return the amounts of a change and the calibration after it; a linear change to where the lens model has no
    parameters is halved until it has."""
    amounts = change.amounts
    for _ in range(RANGE_HALVINGS):
        try:
            return amounts, monitored.changed(change.hypothesis.directions @ amounts)
        except InputError:
            amounts = 0.5 * amounts
    return np.zeros_like(amounts), monitored


def _refined(monitored: Monitored, look: Look, change: Change) -> tuple[FloatArray, Monitored, FreshEvidence]:
    """Return the amounts of a change, the calibration after it, and the evidence of the frames there, after further
    Gauss-Newton iterations while these lower the residuals."""
    amounts, fixed = _as_far_as_the_model(monitored, change)
    after = look(fixed)
    for _ in range(FIX_ROUNDS):
        try:
            again = _fit_hypothesis(Whitened.of(fixed, after), change.hypothesis)
        except DegenerateError:
            again = None
        if again is None:
            break
        try:
            closer = monitored.changed(change.hypothesis.directions @ (amounts + again.amounts))
            then = look(closer)
        except (DegenerateError, InputError):  # So large a step that no point, or no such lens, is left.
            break
        if then.rms_px > after.rms_px:
            break
        amounts, fixed, after = amounts + again.amounts, closer, then
    return amounts, fixed, after


def _fit_hypothesis(whitened: Whitened, hypothesis: Hypothesis) -> Change | None:
    """Return the best fit of a hypothesis; None where it is not observable."""
    by_amount = whitened.by_theta @ hypothesis.directions
    weighed = np.linalg.solve(whitened.covariance, np.column_stack([by_amount, whitened.score]))
    normal, right = by_amount.T @ weighed[:, :-1], by_amount.T @ weighed[:, -1]
    size = root_diagonal(normal)
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
        hypothesis=hypothesis,
        amounts=amounts,
        covariance=covariance,
        freedom=whitened.freedom,
        chance=chance,
        size_px=0.0,
        max_px=0.0,
        gain=gain,
    )


def _sizes_px(
    monitored: Monitored, evidence: FreshEvidence, step: FloatArray, step_covariance: FloatArray
) -> tuple[float, float]:
    """Return the size of a change `step` (T,) of theta with covariance `step_covariance`, and an upper bound. The
    size is the largest rms displacement of: the projection of any one camera, after the best rotation; distant points
    seen by any one camera that turned on its mount; the corners. The square of an estimate is biased by its variance,
    which is subtracted for the size, but not for the bound."""
    shown = evidence.information.sum(axis=0) / evidence.corners
    turns = [_turn_weight(monitored, c) for c in range(1, len(monitored.cameras))]
    weights = [shown, *(goal.weight for goal in lens_goals(monitored)), *turns]
    squares = np.array([(step @ weight @ step, (weight * step_covariance).sum()) for weight in weights])
    return float(np.sqrt(max(0.0, *(squares[:, 0] - squares[:, 1])))), float(np.sqrt(max(0.0, *squares[:, 0])))


def _turn_weight(monitored: Monitored, c: int) -> FloatArray:
    """Return the quadratic form (T, T) of `turn_weight` for camera `c` in a change of theta."""
    layout = monitored.layout
    turn = layout.mount(c).start
    out = np.zeros((layout.count, layout.count))
    out[turn : turn + 3, turn : turn + 3] = turn_weight(monitored.cameras[c])
    return out
