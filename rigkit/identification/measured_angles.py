"""Which of several boards that look alike is which, by the angles that a person measured between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import permutations, product

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.truth import MeasuredAngle
from rigkit.geometry.board_pose import facing_normal
from rigkit.geometry.rotation import angle_between
from rigkit.identification.pair_identity import PairIdentity
from rigkit.identification.placements import board_kinds

POSED_SIGMA_DEG = 0.3
"""Largest standard deviation of the angle between two boards as their poses in a pair show it."""

ANGLE_ODDS = 2.0 * np.log(1000.0)
"""Angles favour other ids where chi2 is smaller by so much, and favour alike all ids within so much of the smallest:
as the odds in `rigkit.identification.identify`."""

MAX_ANGLE_SIGMAS = 4.0
"""Largest deviation of an angle, in sigmas, under the ids it favours."""

MAX_ALIKE = 6
"""More boards of one kind are not identified by angles: their orders are too many to try."""


def ids_by_angles(
    identity: PairIdentity, boards: Sequence[Board], angles: Sequence[MeasuredAngle]
) -> list[dict[str, str]]:
    """Return other ids for those of `boards` that look alike, if the angles clearly favour them; else an empty list.

    Parameters
    ----------
    identity : the boards of the pair with their poses, as identified without the angles.
    boards : the boards whose ids may be exchanged.
    angles : between boards, as measured.

    Returns
    -------
    Each entry maps present ids to new ids. Where the angles favour several, all are returned, fewest changes first.
    """
    faces = {board_id: facing_normal(pose) for board_id, pose in identity.cam1_from_board.items()}
    known = [a for a in angles if a.a in faces and a.b in faces]
    choices = list(_exchanged_ids([b for b in boards if b.board_id in faces])) if known else []
    if not choices:
        return []

    def deviations(names: Mapping[str, str]) -> FloatArray:
        """Return how far each angle is off if the board called k is truly `names[k]`, in sigmas."""
        face_of = {names.get(k, k): face for k, face in faces.items()}
        ours = [180.0 - np.rad2deg(angle_between(face_of[a.a], face_of[a.b])) for a in known]
        sigma = np.hypot([a.sigma_deg for a in known], POSED_SIGMA_DEG)
        return np.asarray((np.array(ours) - [a.value_deg for a in known]) / sigma)

    own, *others = (deviations(names) for names in ({}, *choices))
    chi2 = np.sum(np.square(others), axis=1)
    enough = min(float(chi2.min()) + ANGLE_ODDS, float(own @ own) - ANGLE_ODDS)
    fitting = [n for n, off in enumerate(others) if chi2[n] <= enough and np.abs(off).max() <= MAX_ANGLE_SIGMAS]
    # Right angles say the same of several names: then as few as possible are changed.
    renamed = [{k: other for k, other in choices[n].items() if k != other} for n in fitting]
    return sorted(renamed, key=len)


def _exchanged_ids(boards: Sequence[Board]) -> Iterator[dict[str, str]]:
    """Yield every exchange of ids among boards that look alike."""
    alike = [kind.ids for kind in board_kinds(boards) if 1 < len(kind.ids) <= MAX_ALIKE]
    for orders in product(*(permutations(ids) for ids in alike)):
        names = {a: b for ids, order in zip(alike, orders, strict=True) for a, b in zip(ids, order, strict=True)}
        if any(a != b for a, b in names.items()):
            yield names
