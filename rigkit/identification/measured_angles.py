"""Ids of boards that look alike, by measured angles between them."""

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
"""Upper bound of the standard deviation of the angle between two boards from their poses in a pair."""

ANGLE_ODDS = 2.0 * np.log(1000.0)
"""Difference of chi2 at which angles decide between ids, equal to the odds in `rigkit.identification.identify`."""

MAX_ANGLE_SIGMAS = 4.0
"""Largest residual of an angle, in sigmas, under the ids chosen."""

MAX_ALIKE = 6
"""Largest number of boards of one kind whose permutations are tried."""


def ids_by_angles(
    identity: PairIdentity, boards: Sequence[Board], angles: Sequence[MeasuredAngle]
) -> list[dict[str, str]]:
    """Return permuted ids of those of `boards` that look alike, if the angles clearly favour them; else an empty list.

    Parameters
    ----------
    identity : the boards of the pair with their poses, as identified without the angles.
    boards : the boards whose ids may be permuted.
    angles : measured between boards.

    Returns
    -------
    Each entry maps present to new ids. If the angles favour several equally, all are returned, fewest changes first.
    """
    faces = {board_id: facing_normal(pose) for board_id, pose in identity.cam1_from_board.items()}
    known = [a for a in angles if a.a in faces and a.b in faces]
    choices = list(_exchanged_ids([b for b in boards if b.board_id in faces])) if known else []
    if not choices:
        return []

    def deviations(names: Mapping[str, str]) -> FloatArray:
        """Return the residuals of the angles, in sigmas, if the board with id k is `names[k]`."""
        face_of = {names.get(k, k): face for k, face in faces.items()}
        ours = [180.0 - np.rad2deg(angle_between(face_of[a.a], face_of[a.b])) for a in known]
        sigma = np.hypot([a.sigma_deg for a in known], POSED_SIGMA_DEG)
        return np.asarray((np.array(ours) - [a.value_deg for a in known]) / sigma)

    own, *others = (deviations(names) for names in ({}, *choices))
    chi2 = np.sum(np.square(others), axis=1)
    enough = min(float(chi2.min()) + ANGLE_ODDS, float(own @ own) - ANGLE_ODDS)
    fitting = [n for n, off in enumerate(others) if chi2[n] <= enough and np.abs(off).max() <= MAX_ANGLE_SIGMAS]
    # Right angles favour several permutations equally: the one with the fewest changes comes first.
    renamed = [{k: other for k, other in choices[n].items() if k != other} for n in fitting]
    return sorted(renamed, key=len)


def _exchanged_ids(boards: Sequence[Board]) -> Iterator[dict[str, str]]:
    """Yield every permutation of ids among boards that look alike, except the identity."""
    alike = [kind.ids for kind in board_kinds(boards) if 1 < len(kind.ids) <= MAX_ALIKE]
    for orders in product(*(permutations(ids) for ids in alike)):
        names = {a: b for ids, order in zip(alike, orders, strict=True) for a, b in zip(ids, order, strict=True)}
        if any(a != b for a, b in names.items()):
            yield names
