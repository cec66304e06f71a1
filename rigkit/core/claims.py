"""Claims that one number is below another, evaluated over a set of comparisons."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Comparison:
    """An instance of a claim: that `smaller` is below `larger`.

    Attributes
    ----------
    smaller, larger : the numbers.
    smaller_name, larger_name : their names, in words.
    unit : of both.
    or_equal : whether the claim holds for equal numbers, as for a limit.
    """

    smaller: float
    smaller_name: str
    larger: float
    larger_name: str
    unit: str = "deg"
    or_equal: bool = False

    @property
    def holds(self) -> bool:
        """Whether the claim holds; with NaN it does not."""
        return self.smaller < self.larger or (self.or_equal and self.smaller == self.larger)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Number of comparisons in which a claim holds, and the worst counterexample."""

    text: str
    holds_in: int
    comparisons: int
    against: str

    @property
    def holds(self) -> bool:
        """Whether the claim holds in every comparison."""
        return self.holds_in == self.comparisons > 0

    @property
    def words(self) -> str:
        if self.holds:
            return f"holds (in all {self.comparisons} comparisons)"
        if self.holds_in == 0:
            return f"does not hold (in none of {self.comparisons} comparisons); {self.against}"
        return f"holds in {self.holds_in} of {self.comparisons} comparisons only; {self.against}"


def evaluate_claim(text: str, comparisons: Iterable[Comparison]) -> Verdict | None:
    """Return the verdict on a claim; None without comparisons."""
    holds, total, against, excess = 0, 0, "", -np.inf
    for c in comparisons:
        total += 1
        if c.holds:
            holds += 1
        elif not c.smaller - c.larger <= excess:
            excess = c.smaller - c.larger
            against = (
                f"contradicted by {c.smaller_name} {c.smaller:.2f} {c.unit}, {c.larger_name} {c.larger:.2f} {c.unit}"
            )
    return Verdict(text, holds, total, against) if total else None
