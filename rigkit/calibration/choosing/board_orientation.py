"""Orientation of boards with rotational symmetry: which views number such a board from the other end.

The first corner of such a board is ambiguous, and for a flat board it does not matter. But if the corners deviate from
the flat board, a view numbered from the other end has these deviations rotated. The part of the deviations that is
invariant under the rotation gives no information; the rest changes its sign. So each view has a sign, and the signs
that agree best on one common deviation maximise s^T K s, with K from the single views. Each view is then tested against
the others: does it contain their common deviation unrotated, or rotated?

Errors of the lens model, or a board bent differently in each view, are smooth. They must not count as deviations of the
board: in each view all displacements that are quadratic over the board, its pose included, are projected out. What is
left are printing errors and bends of higher order, which belong to the board.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.shape import in_enough_views, released_sigma
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3
from rigkit.core.boards import Board
from rigkit.core.detections import grid_turned
from rigkit.geometry.rigid3 import Rigid3

SURE = 10.0
"""Log odds from which a view is renumbered: 20000 to 1, as most views are numbered alike a priori. Measured on boards
whose first corner is known: up to 4.3 for the wrong end, 8 to 70 for views that were turned."""
KNOWN = 0.5
"""Part of the views that must be certain of their orientation: otherwise the common deviation is chance."""


def symmetry_turns(board: Board) -> tuple[int, ...]:
    """Return the quarter turns after which the board looks as before."""
    return (0, *board.turns)


def board_turn(board: Board, quarter_turns: int) -> Rigid3:
    """Return numbered_from_old: from the frame of a board to that of the board numbered from another corner."""
    angle = 0.5 * np.pi * quarter_turns
    turn = np.rint([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    corners = board.points(np.array([[0, 0], [board.columns - 1, board.rows - 1]]))
    # The rotated grid must begin at zero again.
    return Rigid3(turn, -(corners @ turn.T).min(axis=0))


def with_boards_renumbered(
    observations: Observations, state: State, views: BoolArray, quarter_turns: int
) -> tuple[Observations, State]:
    """Return observations and state with the boards of the chosen `views` (V,) numbered from another corner. Residuals
    of flat boards do not change."""
    rotation, translation = state.rotation.copy(), state.translation_mm.copy()
    corner, changed = observations.corner.copy(), list(observations.views)
    for k in np.flatnonzero(views).tolist():
        board = changed[k].board
        changed[k] = replace(changed[k], grid=grid_turned(changed[k].grid, board.size, quarter_turns))
        pose = Rigid3(rotation[k], translation[k]) @ board_turn(board, quarter_turns).inverse()
        rotation[k], translation[k] = pose.rotation, pose.translation_mm
        index = observations.first_row[observations.board[k]] + board.index(changed[k].grid)
        corner[k, : len(index)] = index
    observations = replace(observations, views=tuple(changed), corner=corner)
    return observations, replace(state, rotation=rotation, translation_mm=translation)


def misnumbered_views(observations: Observations, fit: Fit, quarter_turns: int) -> BoolArray:
    """Return the views (V,) whose board is certainly numbered by so many quarter turns differently from most others."""
    out = np.zeros(len(observations.views), dtype=bool)
    often = in_enough_views(observations)
    for b, board in enumerate(observations.boards):
        if often[b] and quarter_turns in symmetry_turns(board):
            views = np.flatnonzero(observations.board == b)
            odds = _Patterns.of(observations, fit, b, views, _Turn.of(board, quarter_turns)).log_odds()
            alike, turned = odds > SURE, odds < -SURE
            if alike.sum() + turned.sum() > KNOWN * len(views):
                # The majority decides which end is the first.
                out[views] = turned if turned.sum() <= alike.sum() else alike
    return out


@dataclass(frozen=True, eq=False, slots=True)
class _Turn:
    """A symmetry of a board with M corners: corner i becomes corner `place[i]`, a displacement d `rotation` d. After
    `order` applications it is the identity."""

    place: IntArray
    rotation: Mat3
    order: int

    @classmethod
    def of(cls, board: Board, quarter_turns: int) -> _Turn:
        place = board.index(grid_turned(board.grid(), board.size, quarter_turns))
        rotation = board_turn(board, quarter_turns).rotation
        return cls(place, rotation, 4 // quarter_turns)

    def summed(self, values: FloatArray, sign: float) -> FloatArray:
        """Return `order` times the part of vectors (..., M, 3) that is invariant under the turn (`sign` 1) or changes
        its sign (-1); with `sign` 0 the sum of matrices (..., M, 3, 3) over the orbit of each corner."""
        total, here, turn = np.zeros_like(values), np.arange(len(self.place)), np.eye(3)
        for k in range(self.order):
            if sign:
                total += sign**k * (values[..., here, :] @ turn)
            else:
                total += turn.T @ values[..., here, :, :] @ turn
            here, turn = self.place[here], self.rotation @ turn
        return total


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Patterns:
    """Residuals of one board in V views, in standard deviations, with quadratic fields projected out.

    Attributes
    ----------
    left : (V, 2 C) the residuals.
    by_board : (V, 2 C, 3) derivatives by the displacement of each corner.
    fields : (V, 2 C, K) orthonormal basis of the quadratic fields.
    corner : (V, C) index of each corner on the board.
    pull, information : (V, M, 3) and (V, M, 3, 3) score and information of each view on the deviation of each corner,
        of the part that changes its sign under the turn.
    prior : (3,) inverse prior variances of a corner's deviation.
    """

    left: FloatArray
    by_board: FloatArray
    fields: FloatArray
    corner: IntArray
    pull: FloatArray
    information: FloatArray
    prior: FloatArray

    @classmethod
    def of(cls, observations: Observations, fit: Fit, b: int, views: IntArray, turn: _Turn) -> _Patterns:
        rows = slice(observations.first_row[b], observations.first_row[b + 1])
        board, points = observations.boards[b], fit.state.shape.points(fit.state.unknowns)
        flat = board.points()
        points[rows] = flat + turn.summed(points[rows] - flat, 1.0) / turn.order
        part, state = observations.subset(views), fit.state.subset(views).with_boards_held()
        state = replace(state, shape=replace(state.shape, flat=points))
        in_cam, _ = state.points_in_cam(part)
        pixels, valid, d_pixels_d_point, _ = state.camera.project_with_jacobians(in_cam)
        weight = np.where(valid & fit.kept[views], part.weight, 0.0)
        # Corners that do not project are NaN, also with zero weight.
        residual = np.where(weight[..., None] > 0.0, weight[..., None] * (part.pixels - pixels), 0.0)
        by_board = weight[..., None, None] * (d_pixels_d_point @ state.rotation[:, None])
        by_board = np.where(weight[..., None, None] > 0.0, by_board, 0.0)
        corner = np.where(part.present, part.corner - rows.start, 0)
        x, y = (flat[:, :2] / np.abs(flat).max())[corner].transpose(2, 0, 1)
        monomials = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
        shown = (by_board[..., None] * monomials[:, :, None, None, :]).reshape(len(views), 2 * corner.shape[1], -1)
        fields = np.linalg.qr(shown)[0]
        left = residual.reshape(len(views), -1)
        left = left - _projected_onto(fields, left)
        freedom = 2 * int((weight > 0.0).sum()) - fields.shape[2] * len(views)
        sigma = float(np.sqrt((left**2).sum() / max(freedom, 1))) or 1.0
        by_board, left = by_board / sigma, left / sigma
        pull = np.zeros((len(views), len(flat), 3))
        information = np.zeros((len(views), len(flat), 3, 3))
        index = np.nonzero(weight > 0.0)
        at = index[0], corner[index]
        pull[at] = np.einsum("ncij,nci->ncj", by_board, left.reshape(residual.shape))[index]
        information[at] = (np.swapaxes(by_board, -1, -2) @ by_board)[index]
        return cls(
            left=left,
            by_board=by_board.reshape(*left.shape, 3),
            fields=fields,
            corner=corner,
            pull=turn.summed(pull, -1.0),
            information=turn.summed(information, 0.0),
            prior=turn.order / released_sigma(flat) ** 2,
        )

    def log_odds(self) -> FloatArray:
        """Return the log odds (V,) that a view is numbered as the others, rather than turned."""
        views = len(self.left)
        prior = self.prior * np.eye(3)
        total = self.information.sum(axis=0) + prior
        solved = np.linalg.solve(total, self.pull[..., None])[..., 0].reshape(views, -1)
        alike = solved @ self.pull.reshape(views, -1).T
        others = _signs_without_each(alike - np.diag(np.diag(alike)))
        rest = total - self.information
        departure = np.linalg.solve(rest, np.tensordot(others, self.pull, axes=1)[..., None])[..., 0]
        here = np.repeat(np.take_along_axis(departure, self.corner[..., None], axis=1), 2, axis=1)
        expected = (self.by_board * here).sum(axis=-1)
        expected = expected - _projected_onto(self.fields, expected)
        size = np.maximum(np.linalg.norm(expected, axis=1), np.finfo(float).tiny)
        # For a view numbered as the others the mean is `size`, with unit variance if the others' deviation is exact.
        found = (self.left * expected).sum(axis=1) / size
        spread = max(1.0, float(((np.abs(found) - size) ** 2).mean()))
        return np.asarray(2.0 * found * size / spread)


def _projected_onto(basis: FloatArray, values: FloatArray) -> FloatArray:
    """Return the projection of `values` (V, N) onto the orthonormal `basis` (V, N, K)."""
    return np.asarray((basis @ (np.swapaxes(basis, -1, -2) @ values[..., None]))[..., 0])


def _signs_without_each(alike: FloatArray) -> FloatArray:
    """Return for each view (V, V) the signs of the others that maximise s^T `alike` s without that view, most of them
    positive, and zero for itself. The diagonal of `alike` is zero."""
    signs = _improved(alike, np.where(np.linalg.eigh(alike)[1][:, -1:].T < 0.0, -1.0, 1.0))
    own = np.where(np.eye(len(alike)) > 0.0, 0.0, signs if signs.sum() >= 0.0 else -signs)
    found = _improved(alike, own)
    return np.where((found * own).sum(axis=1, keepdims=True) >= 0.0, found, -found)


def _improved(alike: FloatArray, signs: FloatArray) -> FloatArray:
    """Return sets of signs (N, V), each with its worst sign flipped as long as that increases s^T `alike` s; zeros stay
    zero."""
    signs = signs.copy()
    left = np.arange(len(signs))
    # Every flip increases the form; the limit is for increases that are rounding.
    for _ in range(signs.shape[1] ** 2):
        gain = signs[left] * (signs[left] @ alike)
        worst = np.argmin(gain, axis=1)
        gains = gain[np.arange(len(left)), worst] < 0.0
        left, worst = left[gains], worst[gains]
        if not left.size:
            break
        signs[left, worst] *= -1.0
    return signs
