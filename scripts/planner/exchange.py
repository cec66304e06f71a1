"""Views exchanged one by one: what the planner's choice is compared with, where all images are there already."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.planning.goal import Aim
from rigkit.planning.plan import covariance_of

MAX_EXCHANGES = 50
WORTH = 1e-3
"""An exchange of views that gains less than this part of the error is none."""


def exchanged_views(information: FloatArray, views: FloatArray, goal: Aim, taken: Sequence[int]) -> list[int]:
    """Return as many views as `taken`, better ones of C: one after the other is put back where another helps more,
    until none does.

    Reference: V. V. Fedorov, "Theory of Optimal Experiments" (1972), the exchange algorithm.
    """
    chosen = list(taken)
    whole = information + views[chosen].sum(axis=0)
    for _ in range(MAX_EXCHANGES):
        error = float(goal.error(covariance_of(whole)))
        left = np.setdiff1d(np.arange(len(views)), chosen)
        # Every taken view against every one left.
        without = whole - views[chosen]
        after = goal.error(covariance_of(without[:, None] + views[left])) if len(left) else np.full((1, 1), np.inf)
        out, into = np.unravel_index(int(np.argmin(after)), after.shape)
        if not after[out, into] < (1.0 - WORTH) * error:
            break
        whole = without[out] + views[left[into]]
        chosen[out] = int(left[into])
    return chosen
