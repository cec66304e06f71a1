"""Normal equations of the calibration, their damped solution by Schur complement, and their covariance.

For a corner X of a board with pose (R, t): q = R X, p = q + t, pixel = project(p; k). With J = d pixel / d p,

    d pixel / d k = the model's,  d pixel / d w = q x J (row by row),  d pixel / d t = J,  d pixel / d X = J R.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.arrays import FloatArray, Mat3, Points
from rigkit.calibration.camera_prior import camera_prior
from rigkit.calibration.observations import Observations
from rigkit.calibration.shape import ShapeModel
from rigkit.cameras.base import Camera

__all__ = ["Normal", "Step", "normal_equations"]

FLOOR = 1e-24
"""Diagonal entries below this part of the largest are lifted to it: a polynomial's entries span many powers of ten."""


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """A proposed step and the decrease of the cost that the quadratic model promises for it."""

    globals: FloatArray
    poses: FloatArray
    predicted: float


@dataclass(frozen=True, eq=False, slots=True)
class Normal:
    """Blocks of J^T W J and J^T W r: g for the G globals, p for the 6 numbers of each of V poses.

    Attributes
    ----------
    gg (G, G), gp (V, G, 6), pp (V, 6, 6), g (G,), p (V, 6).
    points_from : the globals from here on are released board points: three each, coupled within a point only. None
        where there are none.
    """

    gg: FloatArray
    gp: FloatArray
    pp: FloatArray
    g: FloatArray
    p: FloatArray
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
        if unknowns.size:
            weight = (sigma_px / shape_sigma) ** 2
            own = np.arange(len(g) - unknowns.size, len(g))
            gg[own, own] += weight
            g[own] -= weight * unknowns
        return replace(self, gg=gg, g=g)

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
        inverse = np.linalg.inv(self.pp + damping_p[..., None] * np.eye(6))
        back = inverse @ np.swapaxes(self.gp, -1, -2)
        reduced = self.gg + np.diag(damping_g) - _gemm(self.gp, back)
        free = (inverse @ self.p[..., None])[..., 0]
        step_g = _solve_positive(reduced, self.g - np.einsum("vgi,vi->g", self.gp, free))
        return step_g, free - back @ step_g

    def _eliminate_points(self, damping_g: FloatArray, damping_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Eliminate the released points by their 3x3 blocks: with many points and few views the system of the other
        globals and all poses is the smaller one."""
        p, views = int(self.points_from or 0), len(self.pp)
        count = (len(self.g) - p) // 3
        each = np.arange(count)
        own = self.gg[p:, p:].reshape(count, 3, count, 3)[each, :, each, :]
        inverse = np.linalg.inv(own + damping_g[p:].reshape(count, 3, 1) * np.eye(3))
        system = np.zeros((p + 6 * views, p + 6 * views))
        system[:p, :p] = self.gg[:p, :p] + np.diag(damping_g[:p])
        system[:p, p:] = np.moveaxis(self.gp[:, :p], 0, 1).reshape(p, -1)
        system[p:, :p] = system[:p, p:].T
        blocks = system[p:, p:].reshape(views, 6, views, 6)
        blocks[np.arange(views), :, np.arange(views), :] = self.pp + damping_p[..., None] * np.eye(6)
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
        inverse = np.linalg.pinv(self.pp, hermitian=True)
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
    """Return the diagonal (..., K) for Marquardt's scaling, lifted where it vanishes."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    top = diagonal.max(axis=-1, keepdims=True) if diagonal.size else diagonal
    return np.maximum(diagonal, np.where(top > 0.0, FLOOR * top, 1.0))


def _gemm(gp: FloatArray, back: FloatArray) -> FloatArray:
    """Return sum over views of gp_v @ back_v as one matrix product."""
    count = gp.shape[1]
    return np.asarray(np.moveaxis(gp, 1, 0).reshape(count, -1) @ back.reshape(-1, count))


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


def normal_equations(
    camera: Camera,
    points: Points,
    lever: Points,
    rotation: Mat3,
    shape: ShapeModel,
    observations: Observations,
    weight: FloatArray,
    loss_px: float | None,
) -> Normal:
    """Return the normal equations at corners `points` (V, C, 3) in the camera frame with lever arms R X."""
    with np.errstate(all="ignore"):
        pixels, valid, by_point, by_camera = camera.project_with_jacobians(points)
    residual = observations.pixels - pixels
    if not valid.all():
        # A corner outside the model's field of view has no derivative; it waits until a step brings it back.
        residual = np.where(valid[..., None], residual, 0.0)
        by_point = np.where(valid[..., None, None], by_point, 0.0)
        by_camera = np.where(valid[..., None, None], by_camera, 0.0)
    if loss_px is not None:
        squared = (residual**2).sum(axis=-1) * weight**2
        weight = weight / np.sqrt(1.0 + squared / loss_px**2)
    # Rows of unknowns first: long contiguous runs for the products below.
    by_point, by_camera = np.moveaxis(by_point, (-2, -1), (1, 0)), np.moveaxis(by_camera, (-2, -1), (1, 0))
    p, b = len(by_camera), shape.basis.shape[-1]
    rows = np.empty((p + b + 7, 2, *weight.shape))
    np.multiply(by_camera, weight, out=rows[:p])
    translation = np.multiply(by_point, weight, out=rows[p + b + 3 : p + b + 6])
    by_board = np.einsum("jivc,vjk->kivc", translation, rotation) if shape.count else translation
    if b:
        np.einsum("kivc,vckb->bivc", by_board, shape.basis[observations.corner], out=rows[p : p + b])
    q0, q1, q2 = np.moveaxis(lever, -1, 0)
    rows[p + b] = q1 * translation[2] - q2 * translation[1]
    rows[p + b + 1] = q2 * translation[0] - q0 * translation[2]
    rows[p + b + 2] = q0 * translation[1] - q1 * translation[0]
    np.multiply(np.moveaxis(residual, -1, 0), weight, out=rows[-1])
    normal = _blocks(_gram(rows), p + b)
    return _released(normal, rows, by_board, observations) if shape.kind == "released" else normal


def _gram(rows: FloatArray) -> FloatArray:
    """Return sum over corners and coordinates of the products of rows (K, 2, V, C): (V, K, K)."""
    u, v = np.moveaxis(rows, (1, 2), (0, 1))
    return np.asarray(u @ np.swapaxes(u, -1, -2) + v @ np.swapaxes(v, -1, -2))


def _blocks(product: FloatArray, g: int) -> Normal:
    total = product[:, :g].sum(axis=0)
    return Normal(total[:, :g], product[:, :g, g:-1], product[:, g:-1, g:-1], total[:, -1], product[:, g:-1, -1])


def _released(normal: Normal, rows: FloatArray, by_board: FloatArray, observations: Observations) -> Normal:
    """Append three unknowns for every board point; a corner touches only those of its own point."""
    views, count, p = observations.pixels.shape[0], int(observations.first_row[-1]), len(normal.g)
    cross = np.einsum("jivc,kivc->vcjk", by_board, rows, optimize=True)
    own = np.einsum("jivc,kivc->vcjk", by_board, by_board, optimize=True)
    present = observations.present
    index = observations.corner[present]
    dense = np.zeros((views, count, 3, 6))
    view_of = np.broadcast_to(np.arange(views)[:, None], present.shape)[present]
    dense[view_of, index] = cross[present][..., p : p + 6]
    by_point = np.zeros((count, 3, p + 4))
    np.add.at(by_point, index, np.concatenate([cross[present][..., :p], own[present], cross[present][..., -1:]], -1))
    total = p + 3 * count
    gg, g = np.zeros((total, total)), np.zeros(total)
    gg[:p, :p], g[:p] = normal.gg, normal.g
    gg[p:, :p] = by_point[..., :p].reshape(-1, p)
    gg[:p, p:] = gg[p:, :p].T
    blocks = gg[p:, p:].reshape(count, 3, count, 3)
    blocks[np.arange(count), :, np.arange(count), :] = by_point[..., p : p + 3]
    g[p:] = by_point[..., -1].reshape(-1)
    gp = np.concatenate([normal.gp, dense.reshape(views, -1, 6)], axis=1)
    return Normal(gg, gp, normal.pp, g, normal.p, p)
