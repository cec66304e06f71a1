"""Possible boards of a detection, and its possible positions on them.

A placement maps the grid of a detection to the grid of a board: quarter turns, then a shift. Boards with equal grids
and squares, as listed or rotated by 90 degrees, form one kind: only geometry distinguishes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, grid_turned
from rigkit.core.patterns.base import Pattern

PLACE_ROUNDING = 1e-6
"""Largest difference of positions in squares that is rounding."""
SAME_SQUARE_REL = 0.03
"""Largest relative difference of the squares of boards that look alike."""


@dataclass(frozen=True, eq=False, slots=True)
class BoardKind:
    """Boards that look alike; poses refer to the frame of the first one."""

    boards: tuple[Board, ...]

    @property
    def board(self) -> Board:
        return self.boards[0]

    @property
    def ids(self) -> tuple[str, ...]:
        return tuple(b.board_id for b in self.boards)


@dataclass(frozen=True, slots=True)
class Placement:
    """board grid = grid of `detection.turned(quarter_turns)` + (columns, rows)."""

    quarter_turns: int
    columns: int = 0
    rows: int = 0

    def grid_of(self, detection: BoardDetection) -> IntArray:
        """Return the board grid (N, 2) of the detection's corners, in the detection's order."""
        return self._place(detection.grid, detection)

    def apply(self, detection: BoardDetection, board: Board) -> BoardDetection:
        """Return the detection on the board's own grid."""
        turned = detection.turned(self.quarter_turns)
        grid = turned.grid + np.array([self.columns, self.rows])
        return BoardDetection(detection.board_id, board.columns, board.rows, grid, turned.pixels, turned.sigma_px)

    def board_from_grid(self, detection: BoardDetection, board: Board) -> FloatArray:
        """Return the rigid motion (4, 4), mm, from the frame of the detection's grid to that of the board."""
        origin, along_x, along_y = self._place(np.array([[0, 0], [1, 0], [0, 1]]), detection).astype(np.float64)
        out = np.eye(4)
        out[:2, 0], out[:2, 1] = along_x - origin, along_y - origin
        out[:2, 3] = origin * [board.square_x_mm, board.square_y_mm]
        return out

    def relative_to(self, first: Placement, detection1: BoardDetection, detection2: BoardDetection) -> tuple[int, ...]:
        """Return a key that is equal for all pairs of placements that put detection 2 alike onto detection 1."""
        on_board = self._place(np.array([[0, 0], [1, 0], [0, 1]]), detection2)
        size = (detection1.columns, detection1.rows)
        turned_size = size if first.quarter_turns % 2 == 0 else size[::-1]
        shifted = on_board - np.array([first.columns, first.rows])
        back = grid_turned(shifted, turned_size, -first.quarter_turns)
        return tuple(int(v) for v in back.ravel())

    def _place(self, grid: IntArray, detection: BoardDetection) -> IntArray:
        turned = grid_turned(grid, (detection.columns, detection.rows), self.quarter_turns)
        return np.asarray(turned + np.array([self.columns, self.rows]), dtype=np.int64)


def board_kinds(boards: Sequence[Board]) -> tuple[BoardKind, ...]:
    """Group boards that look alike, in the order of their first members."""
    groups: list[list[Board]] = []
    for board in boards:
        for group in groups:
            if _alike(board, group[0]):
                group.append(board)
                break
        else:
            groups.append([board])
    return tuple(BoardKind(tuple(group)) for group in groups)


def _alike(a: Board, b: Board) -> bool:
    if a.identified or a.pattern != b.pattern:
        return False

    def close(x: float, y: float) -> bool:
        return abs(x - y) <= SAME_SQUARE_REL * max(x, y)

    same = a.size == b.size and close(a.square_x_mm, b.square_x_mm) and close(a.square_y_mm, b.square_y_mm)
    turned = a.size == b.size[::-1] and close(a.square_x_mm, b.square_y_mm) and close(a.square_y_mm, b.square_x_mm)
    return same or (turned and a.pattern.even_steps)


def possible_kinds(detections: Sequence[BoardDetection], kinds: Sequence[BoardKind]) -> list[list[int]]:
    """Return the possible kinds (indices into `kinds`) of each detection of one image; none for a board not listed.

    A board id determines the kind. A grid of the size of a kind is of that kind; if there are more such grids than
    boards, each may also be a part of a larger board, as any smaller grid.
    """
    named = {board_id: k for k, kind in enumerate(kinds) for board_id in kind.ids}
    out: list[list[int]] = []
    sizes = [tuple(sorted((d.columns, d.rows))) for d in detections]
    for d, size in zip(detections, sizes, strict=True):
        if d.board_id in named:
            out.append([named[d.board_id]])
            continue
        # Boards with markers are identified by these only.
        plain = [k for k, kind in enumerate(kinds) if not kind.board.identified]
        whole = [k for k in plain if tuple(sorted(kinds[k].board.size)) == size]
        crowded = sizes.count(size) > sum(len(kinds[k].boards) for k in whole)
        larger = [k for k in plain if k not in whole and placements(d, kinds[k])]
        out.append(whole + larger if crowded or not whole else whole)
    return out


def placements(detection: BoardDetection, kind: BoardKind) -> list[Placement]:
    """Return the possible placements of a detection on a board of a kind, most likely first; empty if it does not fit.

    A whole grid of a board without rotational symmetry (a chessboard with odd columns + rows) has one placement, by
    the detector's convention. Of a square grid rotations by 90 degrees against the convention come last.
    """
    columns, rows = kind.board.size
    if kind.board.identified:
        return [Placement(0)]
    whole = sorted((detection.columns, detection.rows)) == sorted((columns, rows))
    if whole and not kind.board.turns:
        return [Placement(0 if detection.columns == columns else 1)]
    out = []
    for turn in (0, 2, 1, 3):
        size = (detection.columns, detection.rows) if turn % 2 == 0 else (detection.rows, detection.columns)
        out += [
            Placement(turn, right, down) for down in range(rows - size[1] + 1) for right in range(columns - size[0] + 1)
        ]
    pattern = kind.board.pattern
    return out if pattern.even_steps else [place for place in out if _same_positions(detection, place, pattern)]


def _same_positions(detection: BoardDetection, placement: Placement, pattern: Pattern) -> bool:
    """Return whether the corners have the same relative positions on the board as on the detection's own grid; with
    staggered rows not every placement preserves them."""
    own = pattern.positions(detection.grid.astype(np.float64))
    there = pattern.positions(placement.grid_of(detection).astype(np.float64))
    for _ in range(placement.quarter_turns):
        own = np.stack([-own[:, 1], own[:, 0]], axis=-1)
    return bool(np.ptp(there - own, axis=0).max() < PLACE_ROUNDING)


def describe(detection: BoardDetection) -> str:
    """Return a description of a detection by its size and position."""
    u, v = detection.pixels.mean(axis=0)
    return f"the {detection.columns}x{detection.rows} grid round ({u:.0f}, {v:.0f})"
