"""The solved poses of boards mounted to each other, with covariance, and their angles and distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.solving.clustered import widening
from rigkit.core.arrays import FloatArray, Points, keep_arrays
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.truth import Feature
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, skew


@dataclass(frozen=True, eq=False, slots=True)
class MountedBoard:
    """A board, its solved corners (columns * rows, 3) mm in its own frame, and its pose on the target."""

    board: Board
    points_mm: Points
    target_from_board: Rigid3

    def __post_init__(self) -> None:
        keep_arrays(self, points_mm=(self.board.corner_count, 3))

    def __repr__(self) -> str:
        return f"MountedBoard({self.board!r}, {len(self.points_mm)} solved corners, {self.target_from_board!r})"

    def point(self, feature: Feature) -> FloatArray:
        """Return the position of a corner or the centre in the board's frame, (3,) mm."""
        if feature.grid is None:
            return np.asarray(self.points_mm.mean(axis=0))
        column, row = feature.grid
        if not (column < self.board.columns and row < self.board.rows):
            raise InputError(
                f"'{feature}': board '{self.board.board_id}' has {self.board.columns}x{self.board.rows} corners"
            )
        return np.asarray(self.points_mm[row * self.board.columns + column])

    @property
    def face(self) -> FloatArray:
        """Normal of the face in the target's frame, towards the viewer."""
        return -self.target_from_board.rotation[:, 2]


@dataclass(frozen=True, eq=False, slots=True)
class BoardRig:
    """Boards mounted to each other. The frame is that of the first.

    Attributes
    ----------
    boards : the boards with their poses; that of the first is the identity.
    covariance : (6 (n - 1), 6 (n - 1)) of the poses of all boards but the first: left perturbation (rad), mm. Of a
        Student's t distribution with `freedom` degrees of freedom, which quoted standard deviations account for
        (`widening`).
    image_count : images that show at least two of them.
    scale_sigma : relative standard deviation of all lengths, from the measurement of the squares.
    """

    boards: tuple[MountedBoard, ...]
    covariance: FloatArray
    image_count: int
    scale_sigma: float = 0.0
    freedom: float = float("inf")

    def __post_init__(self) -> None:
        size = 6 * (len(self.boards) - 1)
        keep_arrays(self, covariance=(size, size))

    def __repr__(self) -> str:
        return f"BoardRig of {', '.join(self.names)}, in {self.image_count} images"

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(b.board.board_id for b in self.boards)

    def index(self, name: str) -> int:
        """Return the index of the board `name`; raises InputError that lists the names."""
        if name not in self.names:
            raise InputError(f"no board of this rig is called '{name}'; there are {', '.join(self.names)}")
        return self.names.index(name)

    def angle_deg(self, a: str, b: str) -> tuple[float, float]:
        """Return the angle between the faces of two boards, as a protractor measures it, and its sigma, deg."""
        i, j = self.index(a), self.index(b)
        first, second = self.boards[i].face, self.boards[j].face
        between = float(angle_between(first, second))
        # d angle = -(d first . second + first . d second) / sin, with d n = w x n.
        across = np.cross(first, second)
        unit = across / max(float(np.linalg.norm(across)), np.finfo(float).tiny)
        row = self._row({i: np.concatenate([unit, np.zeros(3)]), j: np.concatenate([-unit, np.zeros(3)])})
        return 180.0 - np.degrees(between), float(np.degrees(self._sigma(row)))

    def distance_mm(self, a: Feature, b: Feature) -> tuple[float, float]:
        """Return the distance of two features and its sigma, mm; from a point to a plane it is perpendicular."""
        if a.is_plane and b.is_plane:
            raise InputError(f"distance {a} to {b}: two planes have no one distance; name a corner of one")
        if a.is_plane:
            a, b = b, a
        i, j = self.index(a.board_id), self.index(b.board_id)
        end, by_end = self._point(i, a)
        other, by_other = self._point(j, Feature(b.board_id, centre=True) if b.is_plane else b)
        between = end - other
        if b.is_plane:
            normal = self.boards[j].face
            signed = float(normal @ between)
            sign = float(np.sign(signed)) or 1.0
            # d (n . (p - q)) = n . (dp - dq) + (w x n) . (p - q)
            turn = np.concatenate([np.cross(normal, between), np.zeros(3)])
            row = self._row({i: sign * (normal @ by_end)}) + self._row({j: sign * (turn - normal @ by_other)})
            length = abs(signed)
        else:
            length = float(np.linalg.norm(between))
            along = between / max(length, np.finfo(float).tiny)
            row = self._row({i: along @ by_end}) - self._row({j: along @ by_other})
        return length, float(np.hypot(self._sigma(row), length * self.scale_sigma))

    def _point(self, k: int, feature: Feature) -> tuple[FloatArray, FloatArray]:
        """Return a point of board `k` in the target's frame and its derivative by the board's pose, (3, 6)."""
        lever = self.boards[k].target_from_board.rotation @ self.boards[k].point(feature)
        return lever + self.boards[k].target_from_board.translation_mm, np.concatenate(
            [-skew(lever), np.eye(3)], axis=1
        )

    def _row(self, parts: dict[int, FloatArray]) -> FloatArray:
        row = np.zeros(len(self.covariance))
        for k, part in parts.items():
            if k > 0:
                row[6 * (k - 1) : 6 * k] += part
        return row

    def _sigma(self, row: FloatArray) -> float:
        return widening(self.freedom) * float(np.sqrt(max(float(row @ self.covariance @ row), 0.0)))
