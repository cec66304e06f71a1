"""Normal equations of the calibration, their damped solution by Schur complement, and their covariance.

For a corner X of a board with pose (R, t): q = R X, p = q + t, pixel = project(p; k). With J = d pixel / d p,

    d pixel / d k = the model's,  d pixel / d w = q x J (row by row),  d pixel / d t = J,  d pixel / d X = J R.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, IntArray, Mat3, Points
from rigkit.calibration.camera_prior import camera_prior
from rigkit.calibration.observations import Observations
from rigkit.calibration.shape import ShapeModel
from rigkit.cameras.base import Camera

__all__ = ["Normal", "Residuals", "Step", "lost_px", "normal_equations"]

BLOCK = 8192
"""Corners linearised at a time: their derivatives then stay in the cache, and memory does not grow with the views."""

MAX_CONDITION = 1e12
"""A pose whose scaled block is worse has directions that its corners leave open: fewer than three of them."""


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """A proposed step and the decrease of the cost that the quadratic model promises for it."""

    globals: FloatArray
    poses: FloatArray
    predicted: float


@dataclass(frozen=True, eq=False, slots=True)
class Residuals:
    """Measured minus projected, (V, C, 2) px, and where the corner projects at all.

    Where it does not, `px` is the diagonal of the image: worse than any other, so that no step gains by losing corners.
    """

    px: FloatArray
    valid: BoolArray

    def norm(self, observations: Observations) -> FloatArray:
        """Return |r| (V, C), infinite where the corner does not project, NaN where padded."""
        length = np.where(self.valid, np.linalg.norm(self.px, axis=-1), np.inf)
        return np.where(observations.present, length, np.nan)

    def weighted(self, observations: Observations) -> FloatArray:
        """Return |r| (V, C) times the weight, infinite where the corner does not project, zero where padded."""
        u, v = self.px[..., 0], self.px[..., 1]
        length = np.sqrt(u * u + v * v) * observations.weight
        return length if self.valid.all() else np.where(self.valid | ~observations.present, length, np.inf)


@dataclass(frozen=True, eq=False, slots=True)
class Normal:
    """Blocks of J^T W J and J^T W r: g for the G globals, p for the 6 numbers of each of V poses.

    Attributes
    ----------
    gg (G, G), gp (V, G, 6), pp (V, 6, 6), g (G,), p (V, 6).
    costs : (V,) cost of each view's residuals, px^2.
    residuals : of the corners, not weighted; those of all cameras of a rig one after the other.
    prior_cost : what the priors add to the cost, px^2.
    points_from : the globals from here on are released board points: three each, coupled within a point only. None
        where there are none.
    """

    gg: FloatArray
    gp: FloatArray
    pp: FloatArray
    g: FloatArray
    p: FloatArray
    costs: FloatArray
    residuals: tuple[Residuals, ...]
    prior_cost: float = 0.0
    points_from: int | None = None

    def with_priors(self, camera: Camera, sigma_px: float, shape_sigma: FloatArray, unknowns: FloatArray) -> Normal:
        """Add the prior of the camera on the first globals, and zero-mean priors of the shape's unknowns on the last.

        `sigma_px` is the standard deviation of a corner: what a residual of one px weighs against a prior.
        """
        gg, g = self.gg.copy(), self.g.copy()
        rows, residual = camera_prior(camera)
        p = camera.parameters.size
        gg[:p, :p] += sigma_px**2 * rows.T @ rows
        g[:p] -= sigma_px**2 * rows.T @ residual
        cost = sigma_px**2 * float(residual @ residual)
        if unknowns.size:
            weight = (sigma_px / shape_sigma) ** 2
            own = np.arange(len(g) - unknowns.size, len(g))
            gg[own, own] += weight
            g[own] -= weight * unknowns
            cost += float((weight * unknowns**2).sum())
        return replace(self, gg=gg, g=g, prior_cost=cost)

    @property
    def cost(self) -> float:
        """The cost, priors included, infinite where the state makes no camera."""
        total = float(self.costs.sum()) + self.prior_cost
        return total if np.isfinite(total) else np.inf

    def step(self, damping: float) -> Step | None:
        """Return the damped Gauss-Newton step, None where the damped system is not positive definite."""
        damping_g, damping_p = damping * _diagonal(self.gg), damping * _diagonal(self.pp)
        first = self.points_from
        many = first is not None and len(self.g) - first > 6 * len(self.pp)
        try:
            solve = self._eliminate_points if many else self._eliminate_poses
            step_g, step_p = solve(damping_g, damping_p)
        except np.linalg.LinAlgError:
            return None
        if not (np.isfinite(step_g).all() and np.isfinite(step_p).all()):
            return None
        # Decrease of the undamped model for the damped step: h^T (mu D h + b).
        predicted = float(step_g @ (damping_g * step_g + self.g))
        predicted += float((step_p * (damping_p * step_p + self.p)).sum())
        return Step(step_g, step_p, predicted)

    def _eliminate_poses(self, damping_g: FloatArray, damping_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        count = len(self.g)
        coupled = np.concatenate([self.gp, self.p[:, None]], axis=1)
        back = np.linalg.inv(_damped(self.pp, damping_p)) @ np.swapaxes(coupled, -1, -2)
        through = _gemm(self.gp, back)
        reduced = _damped(self.gg, damping_g) - through[:, :count]
        step_g = _solve_positive(reduced, self.g - through[:, count])
        return step_g, -(back @ np.append(step_g, -1.0))

    def _eliminate_points(self, damping_g: FloatArray, damping_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Eliminate the released points by their 3x3 blocks: with many points and few views the system of the other
        globals and all poses is the smaller one."""
        p, views = int(self.points_from or 0), len(self.pp)
        count = (len(self.g) - p) // 3
        each = np.arange(count)
        own = self.gg[p:, p:].reshape(count, 3, count, 3)[each, :, each, :]
        inverse = np.linalg.inv(_damped(own, damping_g[p:].reshape(count, 3)))
        system = np.zeros((p + 6 * views, p + 6 * views))
        system[:p, :p] = self.gg[:p, :p] + np.diag(damping_g[:p])
        system[:p, p:] = np.moveaxis(self.gp[:, :p], 0, 1).reshape(p, -1)
        system[p:, :p] = system[:p, p:].T
        blocks = system[p:, p:].reshape(views, 6, views, 6)
        blocks[np.arange(views), :, np.arange(views), :] = _damped(self.pp, damping_p)
        coupling = np.concatenate([self.gg[:p, p:], np.moveaxis(self.gp[:, p:], 1, 2).reshape(-1, 3 * count)])
        back = np.einsum("amk,mkl->aml", coupling.reshape(-1, count, 3), inverse).reshape(len(coupling), -1)
        rhs = np.concatenate([self.g[:p], self.p.ravel()]) - back @ self.g[p:]
        step = _solve_positive(system - back @ coupling.T, rhs)
        points = (inverse @ (self.g[p:] - coupling.T @ step).reshape(count, 3, 1)).reshape(-1)
        return np.concatenate([step[:p], points]), step[p:].reshape(views, 6)

    def covariance(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return S^-1 (G, G), W = pp^-1 gp^T (V, 6, G) and pp^-1 (V, 6, 6): the covariance of globals g and poses p
        for unit residuals is cov(g) = S^-1, cov(p_v, g) = -W_v S^-1, cov(p_v, p_u) = W_v S^-1 W_u^T + [v = u] pp_v^-1.

        Directions that the data leave open get the pseudo-inverse's zero only after scaling to unit diagonal.
        """
        inverse = _inverse(self.pp)
        back = inverse @ np.swapaxes(self.gp, -1, -2)
        reduced = self.gg - _gemm(self.gp, back)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), np.finfo(float).tiny))
        scaled = 0.5 * (reduced + reduced.T) * scale[:, None] * scale
        try:
            inner = np.linalg.inv(scaled)
        except np.linalg.LinAlgError:
            inner = np.linalg.pinv(scaled, hermitian=True)
        return np.asarray(inner * scale[:, None] * scale), back, np.asarray(inverse)


def _diagonal(matrix: FloatArray) -> FloatArray:
    """Return the diagonal (..., K) for Marquardt's scaling, one where it vanishes. Its entries are not compared: they
    have units of their own, and those of a polynomial's coefficients lie 40 powers of ten apart."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    return np.where(diagonal > 0.0, diagonal, 1.0)


def _damped(matrices: FloatArray, damping: FloatArray) -> FloatArray:
    """Return matrices (..., K, K) with `damping` (..., K) added to their diagonals."""
    out = np.array(matrices, order="C")
    count = damping.shape[-1]
    out.reshape(*damping.shape[:-1], count * count)[..., :: count + 1] += damping
    return out


def _inverse(pp: FloatArray) -> FloatArray:
    """Return the inverses of the poses' blocks (V, 6, 6); the pseudo-inverses where the corners leave a pose open."""
    scale = 1.0 / np.sqrt(_diagonal(pp))
    scale = scale[:, :, None] * scale[:, None]
    scaled = pp * scale
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        inverse = np.full_like(pp, np.inf)
    # The scaled blocks have unit diagonals, so this bounds their condition within a factor of six.
    doubtful = ~(np.abs(inverse).max(axis=(1, 2)) < MAX_CONDITION)
    inverse *= scale
    if doubtful.any():
        inverse[doubtful] = np.linalg.pinv(pp[doubtful], hermitian=True)
    return np.asarray(inverse)


def _gemm(gp: FloatArray, back: FloatArray) -> FloatArray:
    """Return sum over views of gp_v @ back_v as one matrix product."""
    return np.asarray(gp.transpose(1, 0, 2).reshape(gp.shape[1], -1) @ back.reshape(-1, back.shape[-1]))


def _solve_positive(matrix: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve after scaling to unit diagonal; raises LinAlgError where the matrix is not positive definite."""
    if not len(rhs):
        return rhs
    diagonal = np.diag(matrix)
    if not (diagonal > 0.0).all():
        raise np.linalg.LinAlgError
    scale = 1.0 / np.sqrt(diagonal)
    scaled = matrix * scale[:, None] * scale
    np.linalg.cholesky(scaled)
    return np.asarray(np.linalg.solve(scaled, rhs * scale) * scale)


def lost_px(camera: Camera) -> float:
    """Return the residual per coordinate of a corner outside the model's field of view: the diagonal of the image."""
    return float(np.hypot(*camera.size_px))


def normal_equations(
    camera: Camera,
    rotation: Mat3,
    translation_mm: Points,
    shape: ShapeModel,
    unknowns: FloatArray,
    observations: Observations,
    weight: FloatArray,
    loss_px: float | None,
) -> Normal:
    """Return the normal equations and the cost for boards at the poses (V, 3, 3), (V, 3) with the shape's `unknowns`.

    `weight` (V, C) multiplies the residuals; `loss_px` is the scale of the Cauchy loss, None for least squares.
    """
    table = np.ascontiguousarray(shape.points(unknowns).T)
    views, corners = weight.shape
    count = camera.parameters.size + shape.basis.shape[-1]
    gg, g = np.zeros((count, count)), np.zeros(count)
    gp, pp = np.empty((views, count, 6)), np.empty((views, 6, 6))
    p, costs = np.empty((views, 6)), np.empty(views)
    # Coordinates first in memory: every later step takes u and v apart.
    px = np.moveaxis(np.empty((2, views, corners)), 0, -1)
    residuals = Residuals(px, np.empty((views, corners), dtype=bool))
    released = _Released(len(shape.flat), views, count) if shape.kind == "released" else None
    step = max(1, BLOCK // max(corners, 1))
    for first in range(0, views, step):
        block = slice(first, min(first + step, views))
        part = _Part(
            rotation[block],
            translation_mm[block],
            observations.corner[block],
            observations.pixels[block],
            weight[block],
            Residuals(residuals.px[block], residuals.valid[block]),
        )
        rows = observations.workspace.array(count + 7, 2, len(part.weight), corners)
        costs[block] = _linearise(rows, camera, table, shape, part, loss_px)
        # Per view only what involves its pose; the globals among themselves in one product over all corners.
        each = np.moveaxis(rows, (1, 2), (0, 1))
        product = (each @ np.swapaxes(each[:, :, count:], -1, -2)).sum(axis=0)
        flat = rows[:count].reshape(count, -1)
        gg += flat @ flat.T
        g += product[:, :count, 6].sum(axis=0)
        gp[block], pp[block], p[block] = product[:, :count, :6], product[:, count:-1, :6], product[:, count:-1, 6]
        if released is not None:
            released.add(rows, _by_board(rows, part.rotation), part.corner, observations.present[block], first)
    normal = Normal(gg, gp, pp, g, p, costs, (residuals,))
    return normal if released is None else released.appended(normal)


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
    """Three unknowns for every board point; a corner touches only those of its own point."""

    def __init__(self, points: int, views: int, count: int) -> None:
        self._pose = np.zeros((views, points, 3, 6))
        self._own = np.zeros((points, 3, count + 4))

    def add(self, rows: FloatArray, by_board: FloatArray, corner: IntArray, present: BoolArray, first: int) -> None:
        """Add a block of views, the first of them number `first`."""
        count = len(rows) - 7
        cross = np.einsum("jivc,kivc->vcjk", by_board, rows, optimize=True)[present]
        own = np.einsum("jivc,kivc->vcjk", by_board, by_board, optimize=True)[present]
        index, view = corner[present], first + np.nonzero(present)[0]
        self._pose[view, index] = cross[..., count : count + 6]
        np.add.at(self._own, index, np.concatenate([cross[..., :count], own, cross[..., -1:]], axis=-1))

    def appended(self, normal: Normal) -> Normal:
        """Return the normal equations with these unknowns after the others."""
        points, p = len(self._own), len(normal.g)
        total = p + 3 * points
        gg, g = np.zeros((total, total)), np.zeros(total)
        gg[:p, :p], g[:p] = normal.gg, normal.g
        gg[p:, :p] = self._own[..., :p].reshape(-1, p)
        gg[:p, p:] = gg[p:, :p].T
        blocks = gg[p:, p:].reshape(points, 3, points, 3)
        blocks[np.arange(points), :, np.arange(points), :] = self._own[..., p : p + 3]
        g[p:] = self._own[..., -1].reshape(-1)
        gp = np.concatenate([normal.gp, self._pose.reshape(len(normal.pp), -1, 6)], axis=1)
        return replace(normal, gg=gg, gp=gp, g=g, points_from=p)
