"""How a damped descent behaves: the schedule of its damping, when it stops, and how it says so."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


@dataclass(frozen=True, slots=True, kw_only=True)
class Damping:
    """The damping of a Levenberg-Marquardt descent, as a share of the diagonal of the normal matrix.

    Attributes
    ----------
    start : before the first step.
    shrink : factor after a step that is taken; with `by_gain` the smallest one.
    growth : factor after a step that is refused.
    acceleration : factor of `growth` with every further refusal in a row.
    floor : no smaller after a step that is taken.
    refused_floor : no smaller after a step that is refused.
    ceiling : a descent ends where refused steps bring the damping above it.
    by_gain : shrink by max(shrink, 1 - (2 q - 1)^3) with q the gain over what the quadratic model promised (Nielsen,
        "Damping parameter in Marquardt's method", 1999, eq. 2.5) instead of by `shrink`.
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
        """Return the damping after a step that gained `ratio` times what was promised."""
        factor = max(self.shrink, 1.0 - (2.0 * ratio - 1.0) ** 3) if self.by_gain else self.shrink
        return max(damping * factor, self.floor)

    def refused(self, damping: float, growth: float) -> tuple[float, float]:
        """Return the damping after a refused step, and the factor for the next refusal."""
        return max(damping * growth, self.refused_floor), growth * self.acceleration


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """When a descent stops.

    Attributes
    ----------
    steps : at most so many are tried.
    gain : a step that is taken and gains no more than this share of the cost is the last one,
    gain_ratio : if it gained more than this share of what the quadratic model promised.
    predicted_gain : a step that promises no more than this share of the cost is not tried.
    cost : a step that arrives below this cost is the last one: what is left is rounding.
    """

    steps: int
    gain: float = 0.0
    gain_ratio: float = 0.0
    predicted_gain: float = 0.0
    cost: float = 0.0


class StopReason(StrEnum):
    """Why a descent stopped, in words for reports."""

    STATIONARY = "cost stationary"
    NO_SMALLER_COST = "no smaller cost nearby"
    SINGULAR = "the normal equations are singular"
    STEPS = "steps used up"
