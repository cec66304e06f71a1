"""Linearising the calibration: all corners' derivatives, block by block, and the normal equations that they make.

For a corner X of a board with pose (R, t): q = R X, p = q + t, pixel = project(p; k). With J = d pixel / d p,

    d pixel / d k = the model's,  d pixel / d w = q x J (row by row),  d pixel / d t = J,  d pixel / d X = J R.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.normal_equations import NormalEquations, Residuals
from rigkit.calibration.observations import Observations
from rigkit.calibration.shape import ShapeModel
from rigkit.calibration.state import State, lost_px
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3, Points

CORNERS_AT_A_TIME = 8192
"""Corners linearised at a time: their derivatives then stay in the cache, and memory does not grow with the views."""


def normal_equations(
    observations: Observations, state: State, weight: FloatArray | None = None, loss_px: float | None = None
) -> NormalEquations:
    """Return the normal equations and the cost at `state`, without priors.

    `weight` (V, C) multiplies the residuals, by default the observations' own; `loss_px` is the scale of the Cauchy
    loss, None for least squares.
    """
    weight = observations.weight if weight is None else weight
    views, corners = weight.shape
    shape = state.shape
    count = state.camera.parameters.size + shape.basis.shape[-1]
    products, costs = np.empty((views, count + 7, count + 7)), np.empty(views)
    # Coordinates first in memory: every later step takes u and v apart.
    px = np.moveaxis(np.empty((2, views, corners)), 0, -1)
    residuals = Residuals(px, np.empty((views, corners), dtype=bool))
    released = _Released(shape, views, count) if shape.kind == "released" else None
    for block, rows in _blocks(observations, state, weight, loss_px, residuals, costs):
        along_u, along_v = np.moveaxis(rows, (1, 2), (0, 1))
        np.matmul(along_u, np.swapaxes(along_u, -1, -2), out=products[block])
        products[block] += along_v @ np.swapaxes(along_v, -1, -2)
        if released is not None:
            by_board = _by_board(rows, state.rotation[block])
            released.add(rows, by_board, observations.corner[block], observations.present[block], block.start)
    shared = products[:, :count].sum(axis=0)
    normal = NormalEquations(
        gg=shared[:, :count],
        gp=products[:, :count, count:-1],
        pp=products[:, count:-1, count:-1],
        g=shared[:, -1],
        p=products[:, count:-1, -1],
        costs=costs,
        residuals=(residuals,),
        products=(products,),
    )
    return normal if released is None else released.appended(normal)


def view_products(observations: Observations, state: State, weight: FloatArray) -> FloatArray:
    """Return the products of every view (V, K, K) that are in the normal equations, released corners held."""
    return normal_equations(observations, state.with_corners_held(), weight).products[0]


def _blocks(
    observations: Observations,
    state: State,
    weight: FloatArray,
    loss_px: float | None,
    residuals: Residuals,
    costs: FloatArray,
) -> Iterator[tuple[slice, FloatArray]]:
    """Yield blocks of views and their weighted rows (K, 2, V, C), valid until the next: derivatives by the globals
    and the pose, and the residual. `residuals` and `costs` (V,) are filled."""
    camera, shape = state.camera, state.shape
    table = np.ascontiguousarray(shape.points(state.unknowns).T)
    views, corners = weight.shape
    count = camera.parameters.size + shape.basis.shape[-1] + 7
    step = max(1, CORNERS_AT_A_TIME // max(corners, 1))
    for first in range(0, views, step):
        block = slice(first, min(first + step, views))
        part = _Part(
            state.rotation[block],
            state.translation_mm[block],
            observations.corner[block],
            observations.pixels[block],
            weight[block],
            Residuals(residuals.px[block], residuals.valid[block]),
        )
        rows = observations.workspace.array(count, 2, len(part.weight), corners)
        costs[block] = _linearise(rows, camera, table, shape, part, loss_px)
        yield block, rows


@dataclass(frozen=True, eq=False, slots=True)
class _Part:
    """What is known of a block of views, and where its residuals go."""

    rotation: Mat3
    translation_mm: Points
    corner: IntArray
    pixels: FloatArray
    weight: FloatArray
    residuals: Residuals


def _linearise(
    rows: FloatArray, camera: Camera, table: FloatArray, shape: ShapeModel, part: _Part, loss_px: float | None
) -> FloatArray:
    """Fill `rows` (K, 2, V, C) with the weighted derivatives by camera, warp and pose, the weighted residual last, and
    the residuals of `part`; return the cost of each view (V,).

    `table` (3, M) are the boards' corners. Rows of unknowns come first: long contiguous runs.
    """
    weight = part.weight
    p, b = camera.parameters.size, shape.basis.shape[-1]
    by_camera, translation, residual = rows[:p], rows[p + b + 3 : p + b + 6], rows[-1]
    by_camera.fill(0.0)
    board = np.take(table, part.corner, axis=1)
    lever = np.empty_like(board)
    np.matmul(part.rotation, np.swapaxes(board, 0, 1), out=np.swapaxes(lever, 0, 1))
    x, y, z = (lever + part.translation_mm.T[:, :, None]).reshape(3, -1)
    u, v, valid = camera.derivatives(
        x, y, z, _by_coordinate(translation, weight.size), _by_coordinate(by_camera, weight.size)
    )
    np.subtract(part.pixels[..., 0], u.reshape(weight.shape), out=residual[0])
    np.subtract(part.pixels[..., 1], v.reshape(weight.shape), out=residual[1])
    squared = residual[0] ** 2 + residual[1] ** 2
    part.residuals.px[..., 0], part.residuals.px[..., 1] = residual
    part.residuals.valid[...] = valid.reshape(weight.shape)
    if not valid.all():
        # A corner outside the model's field of view has no derivative; it waits until a step brings it back.
        lost = ~part.residuals.valid
        rows[..., lost] = 0.0
        part.residuals.px[lost] = lost_px(camera)
        squared[lost] = 2.0 * lost_px(camera) ** 2
    squared *= weight**2
    if loss_px is not None:
        squared /= loss_px**2
        weight = weight / np.sqrt(1.0 + squared)
        squared = loss_px**2 * np.log1p(squared)
    by_camera *= weight
    translation *= weight
    residual *= weight
    if b:
        np.einsum("kivc,vckb->bivc", _by_board(rows, part.rotation), shape.basis[part.corner], out=rows[p : p + b])
    q0, q1, q2 = lever
    for row, (one, k, two, j) in enumerate(((q1, 2, q2, 1), (q2, 0, q0, 2), (q0, 1, q1, 0)), start=p + b):
        np.multiply(one, translation[k], out=rows[row])
        rows[row] -= two * translation[j]
    return np.asarray(squared.sum(axis=-1))


def _by_coordinate(rows: FloatArray, corners: int) -> FloatArray:
    """Return rows (K, 2, V, C) as (2, K, V C), the same memory."""
    return np.swapaxes(rows.reshape(len(rows), 2, corners), 0, 1)


def _by_board(rows: FloatArray, rotation: Mat3) -> FloatArray:
    """Return d pixel / d board point, J R (3, 2, V, C), from the rows of the translation."""
    return np.asarray(np.einsum("jivc,vjk->kivc", rows[-4:-1], rotation))


class _Released:
    """Three unknowns for every released board point; a corner touches only those of its own point."""

    def __init__(self, shape: ShapeModel, views: int, count: int) -> None:
        points = len(shape.released)
        # Where each point of the table stands among those released; beyond them where it is not.
        self._place = np.full(len(shape.flat), points)
        self._place[shape.released] = np.arange(points)
        self._pose = np.zeros((views, points, 3, 6))
        # Products with all rows of its corners, and with their own three.
        self._own = np.zeros((points, 3, count + 10))

    def add(self, rows: FloatArray, by_board: FloatArray, corner: IntArray, present: BoolArray, first: int) -> None:
        """Add a block of views, the first of them number `first`."""
        count = len(rows) - 7
        place = self._place[corner].ravel()
        mine = np.flatnonzero(present.ravel() & (place < len(self._own)))
        # Corners of one point after each other, to be summed.
        mine = mine[np.argsort(place[mine], kind="stable")]
        index, view = place[mine], first + mine // corner.shape[1]
        left = by_board.reshape(3, 2, -1)[..., mine]
        right = np.concatenate([rows.reshape(len(rows), 2, -1)[..., mine], left])
        cross = left.transpose(2, 0, 1) @ right.transpose(2, 1, 0)
        self._pose[view, index] = cross[..., count : count + 6]
        starts = np.flatnonzero(np.diff(index, prepend=-1))
        self._own[index[starts]] += np.add.reduceat(cross, starts, axis=0)

    def appended(self, normal: NormalEquations) -> NormalEquations:
        """Return the normal equations with these unknowns after the others."""
        points, p = len(self._own), len(normal.g)
        total = p + 3 * points
        gg, g = np.zeros((total, total)), np.zeros(total)
        gg[:p, :p], g[:p] = normal.gg, normal.g
        gg[p:, :p] = self._own[..., :p].reshape(-1, p)
        gg[:p, p:] = gg[p:, :p].T
        blocks = gg[p:, p:].reshape(points, 3, points, 3)
        blocks[np.arange(points), :, np.arange(points), :] = self._own[..., p + 7 :]
        g[p:] = self._own[..., p + 6].reshape(-1)
        gp = np.concatenate([normal.gp, self._pose.reshape(len(normal.pp), -1, 6)], axis=1)
        return replace(normal, gg=gg, gp=gp, g=g, points_from=p)
