"""Test of the declared sizes of boards against each other, by the distance between cameras that each gives, and by the
places of boards that are mounted to each other.

One camera cannot test it from single boards: a board of half the size at half the distance looks the same. But every
board gives the distance between two cameras in units of its squares, and these distances must agree. And the place of
one board on another is the same in all images only if both have their sizes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import combinations

import numpy as np

from rigkit.calibration.choosing.board_orientation import symmetry_turns
from rigkit.calibration.rig.views.frames import target_poses
from rigkit.calibration.rig.views.observations import Observation, RigViews
from rigkit.core.arrays import FloatArray
from rigkit.core.findings import Finding
from rigkit.geometry.rotation import rotation_angle
from rigkit.optim.robust_scale import SIGMA_OF_MEDIAN

MIN_FRAMES_OF_BOARD = 3
"""Fewest frames of a board for an estimate of the scatter."""
MIN_SIZE_DIFFERENCE = 0.005
"""Relative difference that is reported: printed boards have errors of 0.001 (REAL: 0.0005 between parts of one board),
exchanged sizes of 0.1."""
SIZES_ERRORS = 6.0
"""The same in standard errors, from the scatter over the frames of both boards."""
SIZES_REMEDY = "measure the squares of both (are the two sizes swapped?), and calibrate again"
MAX_SCATTER_LEFT = 0.5
"""Part of the scatter of a mounted board's places that other sizes may leave; more is of boards that moved."""
MAX_MOTION_LEFT = 0.1
"""The same as a part of the board's motion relative to the camera: of two boards that are not mounted to each other,
one motion does not predict the other."""
MIN_IMAGES_MOUNTED = 5
"""Fewest images of two mounted boards: their place and the ratio of their sizes are four unknowns of three equations
each."""


def board_size_conflicts(views: RigViews) -> tuple[Finding, ...]:
    """Return a finding where two boards contradict each other about the distance of two cameras, or else about their
    places on each other."""
    return _unequal_baselines(views) or tuple(_wandering_places(views))[:1]


def _unequal_baselines(views: RigViews) -> tuple[Finding, ...]:
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


def _wandering_places(views: RigViews) -> Iterator[Finding]:
    """Yield a finding for two boards of a target whose places on each other differ between images as they do with
    distance and tilt if sizes are wrong."""
    for one, other in combinations(sorted(views.places), 2):
        if views.places[one][0] != views.places[other][0]:
            continue
        pairs = _both(views, one, other) or _both(views, other, one)
        if len(pairs) < MIN_IMAGES_MOUNTED:
            continue
        first, (_, at2) = target_poses([a for a, _ in pairs], {}), target_poses([b for _, b in pairs], {})
        at1, at2 = (np.einsum("nji,nj->ni", first[0], at) for at in (first[1], at2))
        at1, at2 = at1 - at1.mean(axis=0), at2 - at2.mean(axis=0)
        squares = float((at2**2).sum())
        ratio = float((at1 * at2).sum()) / squares
        left = float(((at1 - ratio * at2) ** 2).sum())
        sigma = np.sqrt(left / (at1.size - 4) / squares)
        explains = left <= MAX_SCATTER_LEFT**2 * float(((at1 - at2) ** 2).sum())
        mounted = left <= MAX_MOTION_LEFT**2 * float((at1**2).sum())
        if explains and mounted and abs(ratio - 1.0) > max(MIN_SIZE_DIFFERENCE, SIZES_ERRORS * sigma):
            one, other = pairs[0][0].board_id, pairs[0][1].board_id
            yield Finding.bad(
                f"the declared sizes of boards '{one}' and '{other}' are inconsistent: they keep their places on each "
                f"other only if squares of '{other}' are {ratio:.4g} times as large as declared, relative to those of "
                f"'{one}'",
                SIZES_REMEDY,
            )


def _both(views: RigViews, one: str, other: str) -> list[tuple[Observation, Observation]]:
    """Return the observations of two mounted boards in all images that show both. Where a symmetric one was not
    identified, it is turned to its place on the other; none where neither tells how."""
    expected = views.places[one][1].inverse().rotation @ views.places[other][1].rotation
    out = []
    for own in views.seen:
        named = {(entry.frame, entry.board_id): entry for entry in own.values()}
        for (frame, name), a in named.items():
            b = named.get((frame, other)) if name == one else None
            if b is None or ((a.is_alone or b.is_alone) and not _certain(a, b)):
                continue
            turned = [b.turned(turns) for turns in symmetry_turns(b.view.board)]
            to_one = a.cam_from_board.rotation.T
            off = [rotation_angle(to_one @ w.cam_from_board.rotation @ expected.T) for w in turned]
            out.append((a, turned[int(np.argmin(off))]))
    return out


def _certain(one: Observation, other: Observation) -> bool:
    """Return whether two boards do not look alike, and the first does not look the same turned."""
    kinds = [(e.view.board.size, e.view.board.squares_mm, e.view.board.pattern) for e in (one, other)]
    return kinds[0] != kinds[1] and len(symmetry_turns(one.view.board)) == 1


def _error(values: FloatArray) -> float:
    """Return the standard error of the median of values (N,)."""
    spread = SIGMA_OF_MEDIAN * float(np.median(np.abs(values - np.median(values))))
    return float(np.sqrt(0.5 * np.pi / len(values))) * spread


def _finding(cameras: tuple[str, str], boards: tuple[str, str], typical_mm: tuple[float, float]) -> Finding:
    return Finding.bad(
        f"the declared sizes of boards '{boards[0]}' and '{boards[1]}' are inconsistent: they give the baseline of "
        f"cameras '{cameras[0]}' and '{cameras[1]}' as {typical_mm[0]:.4g} mm and {typical_mm[1]:.4g} mm",
        SIZES_REMEDY,
    )
