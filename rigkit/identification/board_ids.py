"""Ids and first corners of boards that look alike, by a rule on their positions as seen from camera 1, or by measured
angles between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.truth import MeasuredAngle
from rigkit.geometry.board_pose import facing_normal
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between
from rigkit.identification.placements import BoardKind, board_kinds

BOARD_SIDES: Mapping[str, tuple[float, float, float]] = {
    "left": (1.0, 0.0, 0.0),
    "right": (-1.0, 0.0, 0.0),
    "floor": (0.0, -1.0, 0.0),
    "ceiling": (0.0, 1.0, 0.0),
    "back": (0.0, 0.0, -1.0),
}
"""Normals of the boards on each side of a scene, in the frame of camera 1."""
THREE = ("right", "floor", "left")
"""Default sides of three boards of one kind in the order listed, clockwise in a corner of a room."""
LEVEL_COSINE = float(np.sqrt(0.5))
"""Boards within 45 degrees of level are on the floor or the ceiling."""
POSED_SIGMA_DEG = 0.3
"""Upper bound of the standard deviation of the angle between two boards from their poses in a pair."""
ANGLE_ODDS = 2.0 * np.log(1000.0)
"""Difference of chi2 at which angles decide between ids, equal to the odds in `rigkit.identification.identify`."""
MAX_ANGLE_SIGMAS = 4.0
"""Largest residual of an angle, in sigmas, under the ids chosen."""
MAX_ALIKE = 6
"""Largest number of boards of one kind whose permutations are tried."""


@dataclass(frozen=True, eq=False, slots=True)
class LocatedBoard:
    """A board of a kind with its pose `cam1_from_board` (4, 4), in the frame of the kind's first board."""

    kind: int
    cam1_from_board: FloatArray
    board_id: str | None = None

    def centre(self, board: Board) -> FloatArray:
        """Return the centre of the board, (3,) mm in camera 1."""
        return np.asarray(self.cam1_from_board[:3, :3] @ board.points().mean(axis=0) + self.cam1_from_board[:3, 3])

    @property
    def face(self) -> FloatArray:
        """The normal that points towards camera 1, for right- and left-handed grids."""
        normal = self.cam1_from_board[:3, 2]
        return np.asarray(-np.sign(normal @ self.cam1_from_board[:3, 3]) * normal)


def assign_board_ids(
    located: Sequence[LocatedBoard], kinds: Sequence[BoardKind], layout: Mapping[str, str] | None = None
) -> tuple[list[str], tuple[str, ...]]:
    """Return a board id for each located board, and notes. No kind may have more located than listed boards.

    The rule for several boards of a kind: known ids are kept. Boards in `layout` are assigned to their sides. Boards
    listed upright (columns x rows swapped) are assigned to those seen upright. The others are assigned in the order
    listed, clockwise around the centre of all boards as camera 1 sees them, starting opposite the floor or ceiling
    board (at twelve o'clock without one): in a corner the right wall, the floor, the left wall. If only some of three
    boards are visible, they are assigned by their sides in that order.
    """
    notes: list[str] = []
    names: list[str | None] = [item.board_id for item in located]
    _check(layout, kinds)
    clock = _clock(located, kinds)
    for k, kind in enumerate(kinds):
        free = [n for n, item in enumerate(located) if item.kind == k and names[n] is None]
        ids = [board_id for board_id in kind.ids if board_id not in names]
        if not free or not ids:
            continue
        if len(kind.ids) > 1:
            sides = {i: layout[i] for i in ids if i in layout} if layout else {}
            if not sides and len(ids) == len(kind.ids) == len(THREE) and len(free) < len(THREE):
                sides = dict(zip(ids, THREE, strict=True))
                notes.append(
                    f"{len(free)} of the equal boards {', '.join(ids)} in sight: named by side ("
                    + ", ".join(f"{i} {side}" for i, side in sides.items())
                    + "); give a layout if they hang otherwise"
                )
            _by_side(located, names, free, sides)
            free = [n for n in free if names[n] is None]
            ids = [i for i in ids if i not in names]
            order = _from_opposite_level(free, located, clock)
            for board, n in _by_shape(order, ids, located, kind):
                names[n] = board
        else:
            names[free[0]] = ids[0]
    return [str(name) for name in names], tuple(notes)


def first_corner_turn(item: LocatedBoard, kind: BoardKind, board: Board, others: Sequence[FloatArray]) -> int:
    """Return the number of quarter turns from the kind's frame to that of `board`, one of its boards.

    If the board is symmetric under rotation, its first corner is the possible one nearest to the mean of the centres of
    the `others` (3,), mm; without others, the one whose columns point most nearly to the right in camera 1. Otherwise
    colours or markers have determined the first corner.
    """
    turns: tuple[int, ...] = (0, *board.turns) if kind.board.size == board.size else (1, 3)
    if not board.turns:
        return turns[0]
    columns, rows = kind.board.columns - 1, kind.board.rows - 1
    # The first corner after `BoardDetection.turned`, and the direction of the columns there.
    first = kind.board.points(np.array([(0, 0), (0, rows), (columns, rows), (columns, 0)]))
    along = {0: (1, 0), 1: (0, -1), 2: (-1, 0), 3: (0, 1)}

    def cost(turn: int) -> float:
        if others:
            corner = item.cam1_from_board[:3, :3] @ first[turn] + item.cam1_from_board[:3, 3]
            return float(np.linalg.norm(corner - np.mean(others, axis=0)))
        return -float(item.cam1_from_board[0, :2] @ np.array(along[turn]))

    return min(turns, key=lambda turn: (round(cost(turn), 6), turn))


def _check(layout: Mapping[str, str] | None, kinds: Sequence[BoardKind]) -> None:
    known = {board_id for kind in kinds for board_id in kind.ids}
    for board_id, side in (layout or {}).items():
        if board_id not in known:
            raise InputError(f"layout: no board is called '{board_id}'; known: {', '.join(sorted(known))}")
        if side not in BOARD_SIDES:
            raise InputError(f"layout: board '{board_id}': side '{side}' is unknown; known: {', '.join(BOARD_SIDES)}")


def _clock(located: Sequence[LocatedBoard], kinds: Sequence[BoardKind]) -> FloatArray:
    """Return the angle of each board around the common centre, rad clockwise from twelve o'clock in camera 1."""
    centres = np.array([item.centre(kinds[item.kind].board) for item in located]).reshape(-1, 3)
    rays = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    right, down = _image_axes(rays.mean(axis=0))
    return np.asarray(np.arctan2(rays @ right, -(rays @ down)) % (2.0 * np.pi))


def _image_axes(towards: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the unit vectors to the right and down, perpendicular to the line of sight `towards` (3,)."""
    sight = towards / np.linalg.norm(towards)
    right = np.cross([0.0, 1.0, 0.0], sight)
    length = np.linalg.norm(right)
    right = right / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
    return right, np.cross(sight, right)


def _from_opposite_level(free: list[int], located: Sequence[LocatedBoard], clock: FloatArray) -> list[int]:
    """Return boards in clockwise order, starting opposite the most level one if that is on floor or ceiling."""
    if not free:
        return []
    level = max(free, key=lambda n: abs(located[n].face[1]))
    start = clock[level] + np.pi if abs(located[level].face[1]) > LEVEL_COSINE else 0.0
    return sorted(free, key=lambda n: ((clock[n] - start) % (2.0 * np.pi), n))


def _by_side(
    located: Sequence[LocatedBoard], names: list[str | None], free: list[int], sides: Mapping[str, str]
) -> None:
    """Assign the ids with a side to the located boards whose normals fit the sides best, IN PLACE in `names`."""
    if not sides:
        return
    from scipy.optimize import linear_sum_assignment

    ids = list(sides)
    likeness = np.array([[located[n].face @ BOARD_SIDES[sides[i]] for i in ids] for n in free])
    for row, column in zip(*linear_sum_assignment(-likeness), strict=True):
        names[free[row]] = ids[column]


def _by_shape(
    order: list[int], ids: list[str], located: Sequence[LocatedBoard], kind: BoardKind
) -> list[tuple[str, int]]:
    """Pair ids with boards in the order given, those of boards listed upright with the most upright boards."""
    shape = {board.board_id: board.size for board in kind.boards}
    alike = [i for i in ids if shape[i] == kind.board.size]
    swapped = [i for i in ids if shape[i] != kind.board.size]
    if not swapped or not alike:
        return list(zip(ids, order, strict=False))

    def tilt(n: int) -> float:
        right, down = _image_axes(located[n].centre(kind.board))
        along = located[n].cam1_from_board[:3, 0]
        return float(np.arctan2(abs(along @ down), abs(along @ right)))

    lying = set(sorted(order, key=tilt)[: len(alike)])
    first = [n for n in order if n in lying]
    rest = [n for n in order if n not in lying]
    return [*zip(alike, first, strict=False), *zip(swapped, rest, strict=False)]


def ids_by_angles(
    cam1_from_board: Mapping[str, Rigid3], boards: Sequence[Board], angles: Sequence[MeasuredAngle]
) -> list[dict[str, str]]:
    """Return permuted ids of those of `boards` that look alike, if the angles clearly favour them; else an empty list.

    Parameters
    ----------
    cam1_from_board : poses of the boards of a pair, as identified without the angles.
    boards : the boards whose ids may be permuted.
    angles : measured between boards.

    Returns
    -------
    Each entry maps present to new ids. If the angles favour several equally, all are returned, fewest changes first.
    """
    faces = {board_id: facing_normal(pose) for board_id, pose in cam1_from_board.items()}
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
