"""Options of Levenberg-Marquardt: the schedule of the damping, and stopping criteria."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


@dataclass(frozen=True, slots=True, kw_only=True)
class Damping:
    """The schedule of the damping, relative to the diagonal of the normal matrix.

    Attributes
    ----------
    start : initial damping.
    shrink : factor after an accepted step; with `by_gain` the smallest factor.
    growth : factor after a rejected step.
    acceleration : factor on `growth` for every further rejection in a row.
    floor : smallest damping after an accepted step.
    refused_floor : smallest damping after a rejected step.
    ceiling : the iteration ends where rejected steps increase the damping above it.
    by_gain : whether the factor is max(shrink, 1 - (2 q - 1)^3) with the gain ratio q, the decrease of the cost over
        that predicted by the quadratic model (Nielsen, "Damping parameter in Marquardt's method", 1999, eq. 2.5).
    """

    start: float
    ceiling: float
    shrink: float = 0.1
    growth: float = 10.0
    acceleration: float = 1.0
    floor: float = 0.0
    refused_floor: float = 0.0
    by_gain: bool = False

    def taken(self, damping: float, ratio: float) -> float:
        """Return the damping after an accepted step with the gain ratio `ratio`."""
        factor = max(self.shrink, 1.0 - (2.0 * ratio - 1.0) ** 3) if self.by_gain else self.shrink
        return max(damping * factor, self.floor)

    def refused(self, damping: float, growth: float) -> tuple[float, float]:
        """Return the damping after a rejected step, and the factor for the next rejection."""
        return max(damping * growth, self.refused_floor), growth * self.acceleration


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """Stopping criteria.

    Attributes
    ----------
    steps : maximal number of steps tried.
    gain : stop after an accepted step with no more than this relative decrease of the cost,
    gain_ratio : if its gain ratio was above this.
    predicted_gain : stop before a step with no more than this predicted relative decrease.
    cost : stop below this cost: the rest is rounding.
    """

    steps: int
    gain: float = 0.0
    gain_ratio: float = 0.0
    predicted_gain: float = 0.0
    cost: float = 0.0


class StopReason(StrEnum):
    """Why the iteration stopped, in words for reports."""

    STATIONARY = "cost stationary"
    NO_SMALLER_COST = "no smaller cost nearby"
    SINGULAR = "the normal equations are singular"
    STEPS = "steps used up"
