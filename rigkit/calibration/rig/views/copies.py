"""Copies of one board in a frame, matched between the cameras of a rig by their arrangement.

Boards without marks that look alike have no names of their own. Two cameras see the same ones where one mount takes
the boards of one camera to those of the other, in all frames.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rigkit.calibration.choosing.board_orientation import symmetry_turns
from rigkit.calibration.rig.views.frames import target_poses
from rigkit.calibration.rig.views.observations import FrameObservations, Observation, RigViews, outer_corners
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3, Points, sampling_step
from rigkit.geometry.rotation import nearest_rotation, unit

MAX_OFF_SQUARES = 0.25
"""Largest mean distance of a board's outer corners from the prediction, in squares, seen from the camera: beyond half a
square a part of a board passes for the part that begins a square further. SIMULATED, 728 walls of 3 to 8 copies (lenses
wrong by 0.2 or 1 %, 0.05 or 0.3 px of noise): none wrong from 0.05 to 0.8. Of 113 without rows all are matched in 93,
in 86 at 0.17 and 95 from 0.35 on; of 113 in a row with gaps that differ by 3 % in 35, 59 at 0.17 and 15 at 0.35."""
MIN_MATCHED = 3
"""Smallest number of boards that determine a mount where no board is known to be the same: two of each camera may fit
by chance. SIMULATED as above, 2 gives the same: two pairs always have a rival."""
MIN_SHARE_OF_RIVAL = 0.5
"""Number of boards that another mount matches, as a part of those that the best one matches, from which neither is
believed. In a row with equal gaps each board may be taken for the next, and of two such mounts the wrong one matches
more where each camera sees another end of the row: 2 of 3 for three boards, 2 of 4 for two rows of two. SIMULATED as
above, equal gaps: wrong in 0 of 206, in 2 at 0.67, in 5 at 0.8, in 51 without a limit."""
MAX_MOUNTS_TRIED = 128
"""Number of mounts tried. One of two copies in two orientations is a quarter of the pairs, one of eight a sixteenth."""
MOUNTS_AT_ONCE = 32

Place = tuple[str, str]
"""Frame and board of an observation in its camera."""
Kind = tuple[object, ...]


def with_copies_matched(views: RigViews) -> RigViews:
    """Return the views in which two cameras share the pose of each copy that both see; in frames in which a camera sees
    several, all others are boards of their own."""
    copies = _copies(views.seen)
    if not any(copies):
        return views
    out = [dict(own) for own in views.seen]
    for c, own in enumerate(out):
        for frame, name in copies[c]:
            own[frame, name] = own[frame, name].alone(c)
    for j in range(1, len(out)):
        for i in range(j):
            # Those that an earlier camera sees, too, share its key already.
            open_ones = [place for place in copies[j] if out[j][place].is_alone]
            for first, second in _matches(out[i], out[j], copies[i], open_ones):
                board = out[i][first].view.board
                key = (first[0], board.board_id)
                out[i][first] = replace(out[i][first], key=key)
                out[j][second] = replace(out[j][second].turned(0, board), key=key)
    return views.with_seen([{(entry.frame, entry.board_id): entry for entry in own.values()} for own in out])


def _kind(entry: Observation) -> Kind:
    board = entry.view.board
    return entry.frame, board.size, board.squares_mm, board.pattern.type


def _copies(seen: Sequence[FrameObservations]) -> list[list[Place]]:
    """Return for each camera its boards without marks that look alike to others of some camera in the same frame."""
    several: set[Kind] = set()
    for own in seen:
        counts = Counter(_kind(entry) for entry in own.values() if not entry.view.board.identified)
        several |= {kind for kind, count in counts.items() if count > 1}
    return [[place for place, e in own.items() if not e.view.board.identified and _kind(e) in several] for own in seen]


class _Pair(NamedTuple):
    """Boards of two cameras in one frame, with their places, that are or may be the same."""

    places: tuple[Place, Place]
    first: Observation
    second: Observation
    known: bool


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Pairs:
    """P pairs of boards that two cameras may share, in all orientations.

    Attributes
    ----------
    places : of both boards.
    owner : number of the first board, (P,), in increasing order.
    known : (P,), boards that are the same by their names.
    rotation, shift_mm : second camera from the first if they are the same, (P, 3, 3) and (P, 3).
    corners1, rays2 : outer corners in the first camera, (P, 4, 3) mm; directions to them from the second.
    square_rad : angle of a square as seen from the second camera, (P,).
    """

    places: list[tuple[Place, Place]]
    owner: IntArray
    known: BoolArray
    rotation: Mat3
    shift_mm: Points
    corners1: FloatArray
    rays2: FloatArray
    square_rad: FloatArray

    @classmethod
    def of(cls, listed: Sequence[_Pair]) -> _Pairs:
        """Return the pairs, `listed` in the order of the first boards, in all orientations of the second."""
        rows = [(pair, turns) for pair in listed for turns in symmetry_turns(pair.second.view.board)]
        boards = [pair.first.view.board for pair, _ in rows]
        corners = np.array([outer_corners(board) for board in boards])
        number = {place: k for k, place in enumerate(dict.fromkeys(pair.places[0] for pair in listed))}
        r1, t1 = target_poses([pair.first for pair, _ in rows], {})
        r2, t2 = target_poses([pair.second.turned(turns) for pair, turns in rows], {})
        rotation = r2 @ np.swapaxes(r1, -1, -2)
        there = np.einsum("pij,pcj->pci", r2, corners) + t2[:, None]
        return cls(
            places=[pair.places for pair, _ in rows],
            owner=np.array([number[pair.places[0]] for pair, _ in rows], dtype=np.int64),
            known=np.array([pair.known for pair, _ in rows]),
            rotation=rotation,
            shift_mm=t2 - np.einsum("pij,pj->pi", rotation, t1),
            corners1=np.einsum("pij,pcj->pci", r1, corners) + t1[:, None],
            rays2=unit(there),
            square_rad=np.array([max(b.squares_mm) for b in boards]) / np.linalg.norm(there.mean(axis=1), axis=-1),
        )

    def off_squares(self, rotation: Mat3, shift_mm: Points) -> FloatArray:
        """Return the distances of the pairs for H mounts (H, 3, 3) and (H, 3), in squares, (H, P)."""
        predicted = np.einsum("hij,pcj->hpci", rotation, self.corners1) + shift_mm[:, None, None]
        return np.asarray(np.linalg.norm(unit(predicted) - self.rays2, axis=-1).mean(axis=-1) / self.square_rad)


def _matches(
    first: FrameObservations, second: FrameObservations, copies1: Collection[Place], copies2: Sequence[Place]
) -> Iterator[tuple[Place, Place]]:
    """Yield the places of the copies of two cameras that are the same boards."""
    same = {entry.key: place for place, entry in second.items()}
    listed = [
        _Pair((place, same[one.key]), one, second[same[one.key]], known=True)
        for place, one in first.items()
        if place not in copies1 and one.key in same
    ]
    loose = [
        _Pair((place, other), first[place], second[other], known=False)
        for place in copies1
        for other in copies2
        if _kind(first[place]) == _kind(second[other])
    ]
    if not loose:
        return
    pairs = _Pairs.of([*listed, *loose])
    taken: set[tuple[int, Place]] = set()
    for p in _same_boards(pairs):
        both = set(enumerate(pairs.places[p]))
        if not pairs.known[p] and not both & taken:
            taken |= both
            yield pairs.places[p]


def _same_boards(pairs: _Pairs) -> list[int]:
    """Return the pairs that fit the best mount, the nearest first; none if no mount is clearly the best."""
    some = np.flatnonzero(pairs.known) if pairs.known.any() else np.arange(len(pairs.owner))
    tried = some[:: sampling_step(len(some), MAX_MOUNTS_TRIED)]
    blocks = np.array_split(tried, math.ceil(len(tried) / MOUNTS_AT_ONCE))
    off = np.concatenate([pairs.off_squares(pairs.rotation[block], pairs.shift_mm[block]) for block in blocks])
    fits = off <= MAX_OFF_SQUARES
    starts = np.flatnonzero(np.diff([-1, *pairs.owner]))
    count = np.logical_or.reduceat(fits, starts, axis=1).sum(axis=1)
    total = np.where(fits, off, 0.0).sum(axis=1)
    best = int(np.lexsort((total, -count))[0])
    mine = fits[best]
    others = 2 * (fits & mine).sum(axis=1) < mine.sum()
    rival = int(count[others].max(initial=0))
    # A mount matches the board with a name from which it was taken, in each orientation.
    own = int(pairs.known.any())
    if count[best] < (1 if own else MIN_MATCHED) or rival - own >= MIN_SHARE_OF_RIVAL * (count[best] - own):
        return []
    rotation = nearest_rotation(np.median(pairs.rotation[mine], axis=0))
    off = pairs.off_squares(rotation[None], np.median(pairs.shift_mm[mine], axis=0)[None])[0]
    return [p for p in np.argsort(off, kind="stable").tolist() if off[p] <= MAX_OFF_SQUARES]
