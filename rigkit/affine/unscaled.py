"""DET3UDIR: the affinity from its determinant and three or more directions without lengths. No epipolar geometry.

In complex numbers A x = z x + w conj(x), with |z|^2 - |w|^2 = det A. In a = (Re z, Im z, Re w, Im w) the sum of squared
residuals is a quadratic form with 2x2 blocks [P, Q; Q^T, R] and the determinant is diag(1, 1, -1, -1), which reduces
the 4x4 generalised eigenproblem to a scalar equation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigkit.affine.components import PlanarDirections, first_of, last_of, smaller_eigenvalue, unit_weights
from rigkit.core.arrays import FloatArray

SCALES = ("area", "ls", "sqmean", "diagonal")

MAX_NEWTON_STEPS = 40
"""Newton converges monotonically and quadratically, usually in 4 to 6 steps; only near-singular sets take more."""

NEWTON_TOLERANCE = 4e-16


class _Form(NamedTuple):
    """The quadratic form [P, Q; Q^T, R], each entry (n,)."""

    p11: FloatArray
    p12: FloatArray
    p22: FloatArray
    q11: FloatArray
    q12: FloatArray
    q21: FloatArray
    q22: FloatArray
    r11: FloatArray
    r12: FloatArray
    r22: FloatArray


def _form(directions: PlanarDirections) -> _Form:
    """Sum the squared residuals Im(conj(u2) A u1) = Im(z g + w h), g = conj(u2) u1, h = conj(u2 u1)."""
    x1, y1, x2, y2 = directions.x1, directions.y1, directions.x2, directions.y2
    w1, w2 = unit_weights(directions)
    w = w1 * w2
    gx, gy = x2 * x1 + y2 * y1, x2 * y1 - y2 * x1
    hx, hy = x2 * x1 - y2 * y1, -(x2 * y1 + y2 * x1)
    wgx, wgy, whx, why = w * gx, w * gy, w * hx, w * hy
    return _Form(
        (wgy * gy).sum(0),
        (wgy * gx).sum(0),
        (wgx * gx).sum(0),
        (wgy * hy).sum(0),
        (wgy * hx).sum(0),
        (wgx * hy).sum(0),
        (wgx * hx).sum(0),
        (why * hy).sum(0),
        (why * hx).sum(0),
        (whx * hx).sum(0),
    )


def shape_block(directions: PlanarDirections) -> tuple[FloatArray, FloatArray]:
    """Return vec(A), (4, n), with determinant 1, and the conditioning, (n,).

    A is the global minimum of sum_k (perp(u2_k)^T A u1_k)^2 over all A of determinant 1, with the sign for which A d1
    points along d2. With three directions the residual is zero unless noise has reversed their cyclic order.

    Notes
    -----
    Stationary points: S a = mu B a. Erratum: the appendix takes the largest generalised eigenvalue (of lambda = -2
    mu); eigen-solvers return mu, of which the smallest positive one is the minimum. Its sign of A is arbitrary.
    With w = -(R + mu)^-1 Q^T z that mu is the largest root of lambda_min(P - Q (R + mu)^-1 Q^T) = mu. The left side is
    concave in mu, so Newton's method started at lambda_min(P), to the right of it, converges monotonically. Its step is
    the Rayleigh quotient a^T S a / a^T B a.
    """
    f = _form(directions)
    count = directions.use.sum(0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Three directions have an exact solution, mu = 0, if its determinant is positive.
        exact = (count == 3) & (_determinant(*_vector(f, np.zeros_like(f.p11))) > 0.0)
        mu = np.where(exact, 0.0, smaller_eigenvalue(f.p11, f.p12, f.p22))
        open_ = np.flatnonzero(~exact)
        for _ in range(MAX_NEWTON_STEPS):
            if not open_.size:
                break
            part = _Form(*(entry[open_] for entry in f))
            before = mu[open_]
            after = _newton_step(part, before)
            mu[open_] = after
            open_ = open_[np.abs(after - before) > NEWTON_TOLERANCE * (part.p11 + part.p22) + 1e-9 * before]
        z1, z2, w1, w2 = _vector(f, mu)
        determinant = _determinant(z1, z2, w1, w2)
        a = np.stack([z1 + w1, w2 - z2, z2 + w2, z1 - w1])
        a *= 1.0 / np.sqrt(np.where(determinant > 0.0, determinant, np.nan))
        a *= np.sign(_agreement(directions, a))
        return a, _third_singular(directions)


def _newton_step(f: _Form, mu: FloatArray) -> FloatArray:
    """Return the Rayleigh quotient of the vector of mu, the result of a Newton step of the scalar equation."""
    z1, z2, w1, w2 = _vector(f, mu)
    numerator = (
        z1 * (f.p11 * z1 + 2.0 * f.p12 * z2)
        + f.p22 * z2 * z2
        + 2.0 * (z1 * (f.q11 * w1 + f.q12 * w2) + z2 * (f.q21 * w1 + f.q22 * w2))
        + w1 * (f.r11 * w1 + 2.0 * f.r12 * w2)
        + f.r22 * w2 * w2
    )
    return np.asarray(np.maximum(numerator / _determinant(z1, z2, w1, w2), 0.0))


def _determinant(z1: FloatArray, z2: FloatArray, w1: FloatArray, w2: FloatArray) -> FloatArray:
    return z1 * z1 + z2 * z2 - w1 * w1 - w2 * w2


def _vector(f: _Form, mu: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return z (unit eigenvector of the smaller eigenvalue of P - Q (R + mu)^-1 Q^T) and w = -(R + mu)^-1 Q^T z."""
    s11, s22 = f.r11 + mu, f.r22 + mu
    inverse = 1.0 / (s11 * s22 - f.r12 * f.r12)
    # T = (R + mu)^-1 Q^T
    t11, t12 = (s22 * f.q11 - f.r12 * f.q12) * inverse, (s22 * f.q21 - f.r12 * f.q22) * inverse
    t21, t22 = (s11 * f.q12 - f.r12 * f.q11) * inverse, (s11 * f.q22 - f.r12 * f.q21) * inverse
    c11 = f.p11 - f.q11 * t11 - f.q12 * t21
    c12 = f.p12 - f.q11 * t12 - f.q12 * t22
    c22 = f.p22 - f.q21 * t12 - f.q22 * t22
    half = 0.5 * (c11 - c22)
    root = np.sqrt(half * half + c12 * c12)
    # The form of the eigenvector without cancellation.
    upper = half > 0.0
    z1 = np.where(upper, -c12, root - half)
    z2 = np.where(upper, half + root, -c12)
    norm = z1 * z1 + z2 * z2
    # Of a multiple of the identity any z is an eigenvector.
    equal = norm == 0.0
    z1, norm = np.where(equal, 1.0, z1), np.where(equal, 1.0, norm)
    length = 1.0 / np.sqrt(norm)
    z1, z2 = z1 * length, z2 * length
    return z1, z2, -(t11 * z1 + t12 * z2), -(t21 * z1 + t22 * z2)


def _agreement(directions: PlanarDirections, a: FloatArray) -> FloatArray:
    """Return sum_k d2_k . A d1_k, (n,): positive where A maps directions along, not against, each other."""
    x1, y1, x2, y2 = directions.x1, directions.y1, directions.x2, directions.y2
    return np.asarray((x2 * (a[0] * x1 + a[1] * y1) + y2 * (a[2] * x1 + a[3] * y1)).sum(0))


def _third_singular(directions: PlanarDirections) -> FloatArray:
    """Return sqrt(e3 / e2) of the rows' Gram matrix, the third singular value if the fourth is (nearly) zero.

    Zero if two of three directions are parallel in both images, so that the shape is not unique.
    """
    w1, w2 = unit_weights(directions)
    x1, y1 = directions.x1 * np.sqrt(w1), directions.y1 * np.sqrt(w1)
    x2, y2 = directions.x2 * np.sqrt(w2), directions.y2 * np.sqrt(w2)
    k = len(x1)
    gram = {}
    for i in range(k):
        for j in range(i, k):
            gram[i, j] = (x1[i] * x1[j] + y1[i] * y1[j]) * (x2[i] * x2[j] + y2[i] * y2[j])
    e2 = np.zeros_like(x1[0])
    e3 = np.zeros_like(x1[0])
    for i in range(k):
        for j in range(i + 1, k):
            e2 += gram[i, i] * gram[j, j] - gram[i, j] ** 2
            for m in range(j + 1, k):
                e3 += (
                    gram[i, i] * (gram[j, j] * gram[m, m] - gram[j, m] ** 2)
                    - gram[i, j] * (gram[i, j] * gram[m, m] - gram[j, m] * gram[i, m])
                    + gram[i, m] * (gram[i, j] * gram[j, m] - gram[j, j] * gram[i, m])
                )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.maximum(e3, 0.0) / e2))


def determinant_from_lengths(directions: PlanarDirections, shape: FloatArray, scale: str) -> FloatArray:
    """Return det A, (n,), from the lengths of the directions.

    "area": ratio of the signed areas that the first two directions span; exact. "ls": the scale of `shape`
    (determinant 1) that fits the lengths best; exact. "sqmean": squared mean of the scales |d2|/|d1|, as in the paper;
    biased unless A is a similarity, for replication. "diagonal": |d2|/|d1| squared of the last direction, likewise.
    """
    x1, y1, x2, y2, use = directions.x1, directions.y1, directions.x2, directions.y2, directions.use
    with np.errstate(divide="ignore", invalid="ignore"):
        if scale == "area":
            first = first_of(use, 1)
            second = first_of(use, 2) & ~first

            def area(x: FloatArray, y: FloatArray) -> FloatArray:
                ax, ay = (x * first).sum(0), (y * first).sum(0)
                return np.asarray(ax * (y * second).sum(0) - ay * (x * second).sum(0))

            return area(x2, y2) / area(x1, y1)
        length1, length2 = np.hypot(x1, y1), np.hypot(x2, y2)
        if scale == "ls":
            a1, a2, a3, a4 = shape
            mapped = np.hypot(a1 * x1 + a2 * y1, a3 * x1 + a4 * y1)
            ratio = (mapped * length2).sum(0) / (mapped * mapped).sum(0)
        elif scale == "sqmean":
            ratio = np.where(use, length2 / length1, 0.0).sum(0) / use.sum(0)
        else:
            last = last_of(use)
            ratio = np.where(last, length2, 0.0).sum(0) / np.where(last, length1, 0.0).sum(0)
        return np.asarray(ratio**2)


def determinant_block(
    directions: PlanarDirections, scale: str, determinant: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return vec(A), (4, n), and the conditioning, (n,), from all directions in use (three at least).

    `determinant` (n,) replaces that from the lengths. NaN where the determinant is not positive: a surface seen from
    the same side by both cameras preserves the cyclic order of directions.
    """
    shape, conditioning = shape_block(directions)
    s = determinant_from_lengths(directions, shape, scale) if determinant is None else determinant
    with np.errstate(invalid="ignore"):
        return shape * np.sqrt(np.where(s > 0.0, s, np.nan)), conditioning
