"""Planar motion (rotation about the vertical axis, horizontal translation): the global least squares optimum.

E = [[0, e1, 0], [e2, 0, e3], [0, e4, 0]] with e = (-cos phi, cos(phi - theta), -sin(phi - theta), sin phi), that is
e1^2 + e4^2 = e2^2 + e3^2 = 1. Rows in normalised coordinates are [x2 y1, y2 x1, y2, y1] of a point and [a1 y1,
y2 + a3 x1, a3, 0], [x2 + a2 y1, a4 x1, a4, 1] of an affinity [[a1, a2], [a3, a4]].

The least squares problem min e^T G e under these two constraints has no duality gap (Brickman 1961): min = 2 max_mu
lambda_min(G + mu J), J = diag(1, -1, -1, 1), a concave problem in one unknown. It replaces the polynomial solvers of
Hajder and Barath ("Relative planar motion for vehicle-mounted cameras from a single affine correspondence", 2020) and
of Guan et al., takes any number of rows, and is batched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import TINY, FloatArray, Mat3
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, check_count, finish, reweighted
from rigkit.relative_pose.solvers.rows import PLANAR_ENTRIES, LinearRows, essential_from_planar
from rigkit.relative_pose.solvers.weights import RowWeights, WeightRule

J_SIGN = np.array([1.0, -1.0, -1.0, 1.0])
NEWTON_STEPS = 12
BISECTIONS = 50
STATIONARY = 1e-10


@dataclass(frozen=True, slots=True)
class PlanarSolver:
    """Two degrees of freedom; at least three equations (three points or one affine correspondence)."""

    degrees_of_freedom: int = 2

    def solve(self, matches: Matches, weights: WeightRule | None = None) -> EpipolarEstimate:
        """Return the globally optimal planar E21; see FundamentalSolver."""
        rows = LinearRows.of(matches, np.eye(9)[list(PLANAR_ENTRIES)])

        def best(row_weights: RowWeights) -> FloatArray:
            check_count(matches, row_weights, 3, "planar motion")
            weighted = rows.weighted(row_weights)
            gram = weighted.T @ weighted
            values = np.linalg.eigvalsh(gram)
            if values[2] <= 1e-14 * values[3]:
                raise DegenerateError(
                    "planar motion is not determined: the points lie on the horizon or there is no baseline; "
                    "use points above or below the camera's height"
                )
            return essential_from_planar(solve_planar_batch(gram[None])[0][0])

        check_baseline(matches)
        E21, used = reweighted(matches, weights, best)
        return finish(matches, E21, E21, used)


def solve_planar_batch(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the global minimisers e (B, 4) of e^T gram e with (e1, e4) and (e2, e3) of unit norm, and the minima (B,).

    `gram` (B, 4, 4) is rows^T rows of each problem, the rows on (e1, e2, e3, e4). The sign of e is arbitrary.

    Notes
    -----
    Newton's method on the derivative v^T J v of the concave dual, safeguarded by a bracket. If the smallest eigenvalue
    is double at the optimum, the bracket is bisected and its two end vectors are combined so that e^T J e = 0. Two
    Newton steps on (phi, phi - theta) remove the rounding error due to the squared condition of the Gram matrix.
    """
    G = np.asarray(gram, dtype=np.float64)
    size = np.trace(G, axis1=1, axis2=2)
    G = G / np.where(size > 0.0, size, 1.0)[:, None, None]
    e = _newton_refined(G, _unit_pairs(_dual_optimum(G)))
    return e, np.einsum("bi,bij,bj->b", e, G, e) * size


def planar_from_two_rows(rows: FloatArray) -> Mat3:
    """Return up to two planar E (B, 2, 3, 3) of rows (B, 2, 4) on the planar entries: e^T J e = 0 in the null space."""
    vt = np.linalg.svd(rows, full_matrices=True)[2]
    a, b = vt[:, 2], vt[:, 3]
    aa, ab, bb = (np.sum(x * J_SIGN * y, axis=1) for x, y in ((a, a), (a, b), (b, b)))
    # cos^2 aa + 2 sin cos ab + sin^2 bb = m + r cos(2w - w0) = 0.
    mean, radius = 0.5 * (aa + bb), np.hypot(0.5 * (aa - bb), ab)
    real = np.abs(mean) <= radius
    turn = np.arccos(np.where(real, -mean / np.where(radius > 0.0, radius, 1.0), 0.0))
    centre = np.arctan2(ab, 0.5 * (aa - bb))
    angle = 0.5 * (centre[:, None] + np.stack([turn, -turn], axis=1))
    e = a[:, None] * np.cos(angle)[..., None] + b[:, None] * np.sin(angle)[..., None]
    return np.where(real[:, None, None, None], essential_from_planar(e), np.nan)


def _dual_optimum(G: FloatArray) -> FloatArray:
    """Return e (B, 4) with e^T J e = 0 at the maximum of lambda_min(G + mu J)."""
    count = len(G)
    out = np.empty((count, 4))
    low, high = np.full(count, -1.0), np.full(count, 1.0)
    # End vectors of the bracket: v^T J v is +1 at mu = -1 and -1 at mu = 1 in the limit.
    v_low, v_high = np.zeros((count, 4)), np.zeros((count, 4))
    mu, todo = np.zeros(count), np.arange(count)
    for step in range(NEWTON_STEPS + BISECTIONS):
        values, vectors = np.linalg.eigh(G[todo] + mu[todo, None, None] * np.diag(J_SIGN))
        v = vectors[:, :, 0]
        along = np.einsum("bi,bik->bk", v * J_SIGN, vectors)
        slope = along[:, 0]
        rising = slope > 0.0
        low[todo[rising]], v_low[todo[rising]] = mu[todo[rising]], v[rising]
        high[todo[~rising]], v_high[todo[~rising]] = mu[todo[~rising]], v[~rising]
        done = np.abs(slope) < STATIONARY
        out[todo[done]] = v[done]
        gap = np.minimum(values[:, :1] - values[:, 1:], -TINY)
        curvature = 2.0 * np.sum(along[:, 1:] ** 2 / gap, axis=1)
        newton = mu[todo] - slope / np.minimum(curvature, -TINY)
        middle = 0.5 * (low[todo] + high[todo])
        inside = (newton > low[todo]) & (newton < high[todo]) & (step < NEWTON_STEPS)
        mu[todo] = np.where(inside, newton, middle)
        todo = todo[~done]
        if todo.size == 0:
            return out
    out[todo] = _on_constraint(G[todo], *_both_ends(G[todo], low[todo], high[todo], v_low[todo], v_high[todo]))
    return out


def _both_ends(
    G: FloatArray, low: FloatArray, high: FloatArray, v_low: FloatArray, v_high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the eigenvectors at both ends of the bracket; those not visited by the iteration are computed."""
    out = []
    for mu, v in ((low, v_low), (high, v_high)):
        fresh = np.linalg.eigh(G + mu[:, None, None] * np.diag(J_SIGN))[1][:, :, 0]
        out.append(np.where(np.any(v != 0.0, axis=1, keepdims=True), v, fresh))
    return out[0], out[1]


def _on_constraint(G: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the better of the two combinations a + s b with e^T J e = 0; a^T J a >= 0 >= b^T J b."""
    aa, ab, bb = (np.sum(x * J_SIGN * y, axis=1) for x, y in ((a, a), (a, b), (b, b)))
    root = np.sqrt(np.maximum(ab * ab - aa * bb, 0.0))
    # Homogeneous roots (s : w) of bb s^2 + 2 ab s w + aa w^2.
    stable = -(ab + np.where(ab < 0.0, -root, root))
    candidates = np.stack([a * bb[:, None] + b * stable[:, None], a * stable[:, None] + b * aa[:, None]], axis=1)
    length = np.linalg.norm(candidates, axis=2, keepdims=True)
    candidates = np.where(length > 0.0, candidates / np.where(length > 0.0, length, 1.0), a[:, None, :])
    cost = np.einsum("bki,bij,bkj->bk", candidates, G, candidates)
    cost = np.where(length[..., 0] > 0.0, cost, np.inf)
    return np.asarray(candidates[np.arange(len(G)), np.argmin(cost, axis=1)])


def _unit_pairs(e: FloatArray) -> FloatArray:
    outer, inner = np.hypot(e[:, 0], e[:, 3]), np.hypot(e[:, 1], e[:, 2])
    return np.asarray(e / np.where(J_SIGN > 0.0, outer[:, None], inner[:, None]))


def _newton_refined(G: FloatArray, e: FloatArray) -> FloatArray:
    """Return e after two Newton steps on its two angles, each accepted where the cost does not rise."""
    cost = np.einsum("bi,bij,bj->b", e, G, e)
    for _ in range(2):
        # d e / d angle: the pairs (e1, e4) and (e2, e3) rotated by 90 degrees.
        turn = np.zeros((len(e), 2, 4))
        turn[:, 0, 0], turn[:, 0, 3] = -e[:, 3], e[:, 0]
        turn[:, 1, 1], turn[:, 1, 2] = -e[:, 2], e[:, 1]
        Ge = np.einsum("bij,bj->bi", G, e)
        gradient = np.einsum("bki,bi->bk", turn, Ge)
        hessian = np.einsum("bki,bij,blj->bkl", turn, G, turn)
        hessian[:, 0, 0] -= e[:, 0] * Ge[:, 0] + e[:, 3] * Ge[:, 3]
        hessian[:, 1, 1] -= e[:, 1] * Ge[:, 1] + e[:, 2] * Ge[:, 2]
        det = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
        safe = np.where(det > 0.0, det, np.inf)
        step = np.stack(
            [
                (hessian[:, 1, 1] * gradient[:, 0] - hessian[:, 0, 1] * gradient[:, 1]) / safe,
                (hessian[:, 0, 0] * gradient[:, 1] - hessian[:, 0, 1] * gradient[:, 0]) / safe,
            ],
            axis=1,
        )
        moved = _unit_pairs(e - np.einsum("bk,bki->bi", step, turn))
        moved_cost = np.einsum("bi,bij,bj->b", moved, G, moved)
        better = moved_cost <= cost
        e, cost = np.where(better[:, None], moved, e), np.where(better, moved_cost, cost)
    return e
