"""Test of the declared sizes of boards against each other, by the distance between cameras that each gives.

One camera cannot test it: a board of half the size at half the distance looks the same. But every board gives the
distance between two cameras in units of its squares, and these distances must agree.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations

import numpy as np

from rigkit.calibration.rig.views.frames import target_poses
from rigkit.calibration.rig.views.observations import RigViews
from rigkit.core.arrays import FloatArray
from rigkit.core.findings import Finding
from rigkit.optim.robust_scale import SIGMA_OF_MEDIAN

MIN_FRAMES_OF_BOARD = 3
"""Fewest frames of a board for an estimate of the scatter."""
MIN_SIZE_DIFFERENCE = 0.01
"""Relative difference that is reported: printed boards have errors of 0.001, exchanged sizes of 0.1."""
SIZES_ERRORS = 6.0
"""The same in standard errors, from the scatter over the frames of both boards."""


def board_size_conflicts(views: RigViews) -> tuple[Finding, ...]:
    """Return a finding where two boards contradict each other about the distance of two cameras."""
    names, seen, places = views.names, views.seen, views.places
    for i, j in combinations(range(len(seen)), 2):
        shared = seen[i].keys() & seen[j].keys()
        pairs = sorted({seen[i][place].key for place in shared if seen[i][place].key == seen[j][place].key})
        if not pairs:
            continue
        own = [{entry.key: entry for entry in seen[k].values()} for k in (i, j)]
        (turn1, at1), (turn2, at2) = (target_poses([each[key] for key in pairs], places) for each in own)
        between = at2 - np.einsum("nij,nkj,nk->ni", turn2, turn1, at1)
        middle = np.median(between, axis=0)
        length = between @ middle / max(float(np.linalg.norm(middle)), np.finfo(float).tiny)
        of_board = defaultdict(list)
        for (_, target), value in zip(pairs, length.tolist(), strict=True):
            of_board[target].append(value)
        measured = {name: np.array(values) for name, values in of_board.items() if len(values) >= MIN_FRAMES_OF_BOARD}
        for one, other in combinations(sorted(measured, key=lambda name: -len(measured[name])), 2):
            typical = [float(np.median(measured[name])) for name in (one, other)]
            chance = float(np.hypot(_error(measured[one]), _error(measured[other])))
            difference = abs(typical[1] - typical[0])
            if min(typical) > 0.0 and difference > max(MIN_SIZE_DIFFERENCE * min(typical), SIZES_ERRORS * chance):
                return (_finding((names[i], names[j]), (one, other), (typical[0], typical[1])),)
    return ()


def _error(values: FloatArray) -> float:
    """Return the standard error of the median of values (N,)."""
    spread = SIGMA_OF_MEDIAN * float(np.median(np.abs(values - np.median(values))))
    return float(np.sqrt(0.5 * np.pi / len(values))) * spread


def _finding(cameras: tuple[str, str], boards: tuple[str, str], typical_mm: tuple[float, float]) -> Finding:
    return Finding.bad(
        f"the declared sizes of boards '{boards[0]}' and '{boards[1]}' are inconsistent: they give the baseline of "
        f"cameras '{cameras[0]}' and '{cameras[1]}' as {typical_mm[0]:.4g} mm and {typical_mm[1]:.4g} mm",
        "measure the squares of both (are the two sizes swapped?), and calibrate again",
    )
