"""Normal equations of the calibration: priors, damped solution by the Schur complement, covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rigkit.calibration.solving.camera_prior import camera_prior
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels.linearise import schur_step

MAX_CONDITION = 1e12
"""Condition number of a pose's scaled block from which it is undetermined: it has fewer than three corners."""


@dataclass(frozen=True, eq=False, slots=True)
class SchurStep:
    """A proposed step in globals (G,) and poses (V, 6), and the decrease of the cost that the quadratic model
    predicts."""

    globals: FloatArray
    poses: FloatArray
    predicted: float


@dataclass(frozen=True, eq=False, slots=True)
class Residuals:
    """Measured minus projected, (V, C, 2) px, and where the corner projects at all.

    Where it does not, `px` is the diagonal of the image, more than any real residual, so that no step gains by losing
    corners.
    """

    px: FloatArray
    valid: BoolArray

    def weighted(self, observations: Observations) -> FloatArray:
        """Return |r| (V, C) times the weight, infinite where the corner does not project, zero where padded."""
        u, v = self.px[..., 0], self.px[..., 1]
        length = np.sqrt(u * u + v * v) * observations.weight
        return length if self.valid.all() else np.where(self.valid | ~observations.present, length, np.inf)


@dataclass(frozen=True, eq=False, kw_only=True)
class NormalEquations:
    """Blocks of J^T W J and J^T W r: g for the G globals, p for the 6 numbers of each of V poses.

    Attributes
    ----------
    gg (G, G), gp (V, G, 6), pp (V, 6, 6), g (G,), p (V, 6).
    costs : (V,) cost of each view's residuals, px^2.
    residuals : unweighted residuals of all corners, one entry for each camera of a rig.
    products : (V, K, K) of each camera: J^T W J of every view, where the K columns are the derivatives by the camera's
        parameters, the boards' warps and the pose (w, t), and last the residual; without released corners and priors.
    prior_cost : cost of the priors, px^2.
    room : (2, G) the steps to the ends of the globals' ranges (`Camera.ends`); None without any.
    points_from : index of the first coordinate of released board points among the globals, three for each point and
        coupled within a point only; None without released points.
    """

    gg: FloatArray
    gp: FloatArray
    pp: FloatArray
    g: FloatArray
    p: FloatArray
    costs: FloatArray
    residuals: tuple[Residuals, ...]
    products: tuple[FloatArray, ...]
    prior_cost: float = 0.0
    points_from: int | None = None
    room: FloatArray | None = None

    def with_priors(
        self,
        cameras: Sequence[tuple[slice, Camera]],
        shape: slice,
        shape_sigma: FloatArray,
        unknowns: FloatArray,
        sigma_px: float,
    ) -> NormalEquations:
        """Add the priors of cameras and the zero-mean priors of the shape's unknowns, at their slices of the globals.

        `sigma_px` is the standard deviation of a corner: it scales residuals in px against the priors.
        """
        gg, g, cost = self.gg.copy(), self.g.copy(), 0.0
        room = np.tile([[-np.inf], [np.inf]], len(g))
        for own, camera in cameras:
            rows, residual = camera_prior(camera)
            rows, residual = sigma_px * rows, sigma_px * residual
            gg[own, own] += rows.T @ rows
            g[own] -= rows.T @ residual
            cost += float(residual @ residual)
            room[:, own] = camera.ends - camera.parameters
        if unknowns.size:
            weight = (sigma_px / shape_sigma) ** 2
            diagonal = np.arange(shape.start, shape.stop)
            gg[diagonal, diagonal] += weight
            g[shape] -= weight * unknowns
            cost += float((weight * unknowns**2).sum())
        return replace(self, gg=gg, g=g, prior_cost=cost, room=room if np.isfinite(room).any() else None)

    def with_quadratic(self, where: slice, off: FloatArray, information: FloatArray) -> NormalEquations:
        """Add the cost off^T information off of globals that deviate by `off` (n,) from their prior mean."""
        gg, g = self.gg.copy(), self.g.copy()
        gg[where, where] += information
        g[where] -= information @ off
        return replace(self, gg=gg, g=g, prior_cost=self.prior_cost + float(off @ information @ off))

    @property
    def cost(self) -> float:
        """The cost, priors included; infinite where it is not finite."""
        total = float(self.costs.sum()) + self.prior_cost
        return total if np.isfinite(total) else np.inf

    def step(self, damping: float) -> SchurStep | None:
        """Return the damped Gauss-Newton step, None where the damped system is not positive definite. Globals that
        would leave their range go to its end, and all others follow (an active set; J. Nocedal, S. Wright, "Numerical
        optimization", 2006, chapter 16.5)."""
        found = self._free_step(damping)
        if found is None or self.room is None:
            return found
        within = np.clip(found.globals, *self.room)
        free = within == found.globals
        if free.all():
            return found
        held = np.where(free, 0.0, within)
        rest = replace(
            self,
            gg=self.gg * free * free[:, None] + np.diag(np.where(free, 0.0, 1.0)),
            gp=self.gp * free[:, None],
            g=(self.g - self.gg @ held) * free,
            p=self.p - held @ self.gp,
            room=np.where(free, self.room, [[-np.inf], [np.inf]]),
        ).step(damping)
        if rest is None:
            return None
        predicted = rest.predicted + float(held @ (2.0 * self.g - self.gg @ held))
        return SchurStep(rest.globals + held, rest.poses, predicted)

    def _free_step(self, damping: float) -> SchurStep | None:
        """Return the step without regard to `room`."""
        first = self.points_from
        if first is None or len(self.g) - first <= 6 * len(self.pp):
            found = schur_step(self.gg, self.gp, self.pp, self.g, self.p, damping)
            return None if found is None else SchurStep(*found)
        damping_g, damping_p = damping * _diagonal(self.gg), damping * _diagonal(self.pp)
        try:
            step_g, step_p = self._eliminate_points(damping_g, damping_p)
        except np.linalg.LinAlgError:
            return None
        if not (np.isfinite(step_g).all() and np.isfinite(step_p).all()):
            return None
        # Decrease of the undamped model for the damped step: h^T (mu D h + b).
        predicted = float(step_g @ (damping_g * step_g + self.g))
        predicted += float((step_p * (damping_p * step_p + self.p)).sum())
        return SchurStep(step_g, step_p, predicted)

    def _eliminate_points(self, damping_g: FloatArray, damping_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the step with the released points eliminated by their 3x3 blocks: with many points and few views the
        system of the other globals and all poses is the smaller one."""
        p, views, own = int(self.points_from or 0), len(self.pp), self.point_blocks
        count = len(own)
        inverse = np.linalg.inv(_damped(own, damping_g[p:].reshape(count, 3)))
        system = np.zeros((p + 6 * views, p + 6 * views))
        system[:p, :p] = self.gg[:p, :p] + np.diag(damping_g[:p])
        system[:p, p:] = np.moveaxis(self.gp[:, :p], 0, 1).reshape(p, -1)
        system[p:, :p] = system[:p, p:].T
        blocks = system[p:, p:].reshape(views, 6, views, 6)
        blocks[np.arange(views), :, np.arange(views), :] = _damped(self.pp, damping_p)
        # One long row for each coordinate of a point: a block multiplies three rows at once.
        coupling = np.concatenate([self.gg[p:, :p], np.moveaxis(self.gp[:, p:], 0, 1).reshape(3 * count, -1)], axis=1)
        back = (inverse @ coupling.reshape(count, 3, -1)).reshape(coupling.shape)
        rhs = np.concatenate([self.g[:p], self.p.ravel()]) - self.g[p:] @ back
        step = _solve_positive(system - coupling.T @ back, rhs)
        points = (inverse @ (self.g[p:] - coupling @ step).reshape(count, 3, 1)).reshape(-1)
        return np.concatenate([step[:p], points]), step[p:].reshape(views, 6)

    @property
    def point_blocks(self) -> FloatArray:
        """The 3x3 blocks (M, 3, 3) of `gg` of the released points."""
        start = int(self.points_from or 0)
        count = (len(self.g) - start) // 3
        each = np.arange(count)
        return np.asarray(self.gg[start:, start:].reshape(count, 3, count, 3)[each, :, each, :])

    @property
    def identifiable(self) -> bool:
        """Whether the equations determine every global: its variance inflation factor is positive and below the limit
        of floating-point arithmetic."""
        inverse, back, _ = self.covariance
        variance = np.diag(inverse)
        # The inverse variance if all other globals were known.
        alone = np.diag(self.gg) - np.einsum("vgi,vig->g", self.gp, back)
        inflated = variance * alone
        limit = 1.0 / (len(inflated) * np.finfo(float).eps)
        return bool((np.isfinite(inflated) & (inflated > 0.0) & (inflated < limit)).all())

    @cached_property
    def covariance(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """S^-1 (G, G), W = pp^-1 gp^T (V, 6, G) and pp^-1 (V, 6, 6): the covariance of globals g and poses p
        for unit residuals is cov(g) = S^-1, cov(p_v, g) = -W_v S^-1, cov(p_v, p_u) = W_v S^-1 W_u^T + [v = u] pp_v^-1.

        A singular matrix is pseudo-inverted after scaling to unit diagonal.
        """
        inverse = pose_inverses(self.pp)
        back = inverse @ np.swapaxes(self.gp, -1, -2)
        views, count, six = self.gp.shape
        # The sum over views of gp_v @ back_v as one matrix product.
        product = self.gp.transpose(1, 0, 2).reshape(count, views * six) @ back.reshape(views * six, -1)
        reduced = self.gg - product
        scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), np.finfo(float).tiny))
        scaled = 0.5 * (reduced + reduced.T) * scale[:, None] * scale
        try:
            inner = np.linalg.inv(scaled)
        except np.linalg.LinAlgError:
            inner = np.linalg.pinv(scaled, hermitian=True)
        return np.asarray(inner * scale[:, None] * scale), back, np.asarray(inverse)


def _diagonal(matrix: FloatArray) -> FloatArray:
    """Return the diagonal (..., K) for Marquardt's scaling, one where it vanishes. Entries are not compared with each
    other: their units differ, and those of a polynomial's coefficients differ by 40 orders of magnitude."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    return np.where(diagonal > 0.0, diagonal, 1.0)


def _damped(matrices: FloatArray, damping: FloatArray) -> FloatArray:
    """Return matrices (..., K, K) with `damping` (..., K) added to their diagonals."""
    out = np.array(matrices, order="C")
    count = damping.shape[-1]
    out.reshape(*damping.shape[:-1], count * count)[..., :: count + 1] += damping
    return out


def pose_inverses(pp: FloatArray) -> FloatArray:
    """Return the inverses of the poses' blocks (V, 6, 6); pseudo-inverses where the corners do not determine a pose."""
    scale = 1.0 / np.sqrt(_diagonal(pp))
    scale = scale[:, :, None] * scale[:, None]
    scaled = pp * scale
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        inverse = np.full_like(pp, np.inf)
    # The scaled blocks have unit diagonals, so this bounds their condition number within a factor of six.
    doubtful = ~(np.abs(inverse).max(axis=(1, 2)) < MAX_CONDITION)
    inverse *= scale
    if doubtful.any():
        inverse[doubtful] = np.linalg.pinv(pp[doubtful], hermitian=True)
    return np.asarray(inverse)


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
