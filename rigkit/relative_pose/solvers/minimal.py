"""Minimal solvers, batched over B samples: what robust estimation draws from.

* F from seven equations (two affine correspondences and a point, or seven points): a cubic in the null space.
* E from five equations (five points, or one affine correspondence and two points): ten cubics in three unknowns, solved
  by a polynomial in one of them (Nister, "An efficient solution to the five-point relative pose problem", 2004).
* E from six equations (two affine correspondences): ten cubics in two unknowns, linear in their ten monomials
  (Eichhardt and Barath; Raposo and Barreto).
* Planar E from two equations (two points): a quadratic; from three (one affine correspondence): solve_planar_batch.

Every solver returns (B, S, 3, 3) with unit Frobenius norm and NaN where a sample has fewer than S real solutions.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3
from rigkit.kernels.minimal import five_rows, six_rows
from rigkit.relative_pose.solvers.rows import essential_from_planar

REAL = 1e-8
"""An eigenvalue or root with a larger imaginary part (relative) is complex."""


def fundamental_from_seven_rows(rows: FloatArray) -> Mat3:
    """Return up to three F (B, 3, 3, 3) of rows (B, 7, 9): det(x F1 + y F2) = 0 in the null space."""
    basis = _null_space(rows, 2)
    first, second = basis[:, 0], basis[:, 1]
    # The cubic in homogeneous (x, y) by its values at four places; a root at infinity is F1 itself.
    at = np.array([-1.0, 0.0, 1.0, 2.0])
    values = np.linalg.det(at[:, None, None] * first[:, None] + second[:, None])
    poly = values @ np.linalg.inv(np.vander(at, 4)).T
    roots, real = _cubic_roots(poly)
    out = first[:, None] * np.cos(roots)[..., None, None] + second[:, None] * np.sin(roots)[..., None, None]
    return _unit(out, real)


def essential_from_five_rows(rows: FloatArray) -> Mat3:
    """Return up to ten E (B, 10, 3, 3) of rows (B, 5, 9)."""
    return five_rows(rows)


def essential_from_six_rows(rows: FloatArray) -> Mat3:
    """Return the E (B, 1, 3, 3) of rows (B, 6, 9), two affine correspondences: the essential matrix nearest to the one
    whose monomials violate the ten cubics least.

    The monomials are scaled so that the answer does not depend on the choice of the basis: all 27 products of three of
    the unknowns, of which ten differ, have the length one together.
    """
    return six_rows(rows)


def planar_from_two_rows(rows: FloatArray) -> Mat3:
    """Return up to two planar E (B, 2, 3, 3) of rows (B, 2, 4) on the planar entries: e^T J e = 0 in the null space."""
    vt = np.linalg.svd(rows, full_matrices=True)[2]
    a, b = vt[:, 2], vt[:, 3]
    sign = np.array([1.0, -1.0, -1.0, 1.0])
    aa, ab, bb = (np.sum(x * sign * y, axis=1) for x, y in ((a, a), (a, b), (b, b)))
    # cos^2 aa + 2 sin cos ab + sin^2 bb = m + r cos(2w - w0) = 0.
    mean, radius = 0.5 * (aa + bb), np.hypot(0.5 * (aa - bb), ab)
    real = np.abs(mean) <= radius
    turn = np.arccos(np.where(real, -mean / np.where(radius > 0.0, radius, 1.0), 0.0))
    centre = np.arctan2(ab, 0.5 * (aa - bb))
    angle = 0.5 * (centre[:, None] + np.stack([turn, -turn], axis=1))
    e = a[:, None] * np.cos(angle)[..., None] + b[:, None] * np.sin(angle)[..., None]
    return _unit(essential_from_planar(e), np.repeat(real[:, None], 2, axis=1))


def _null_space(rows: FloatArray, dimension: int) -> FloatArray:
    """Return an orthonormal basis (B, dimension, 3, 3) of what the rows (B, 9 - dimension, 9) leave."""
    vt = np.linalg.svd(rows, full_matrices=True)[2]
    return np.asarray(vt[:, 9 - dimension :].reshape(-1, dimension, 3, 3))


def _cubic_roots(poly: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the angles w (B, 3) of the roots (cos w : sin w) of homogeneous cubics (B, 4), and which are real.

    A generic rotation of (x : y) keeps a root at infinity away from the leading coefficient.
    """
    turn = 0.7
    c, s = np.cos(turn), np.sin(turn)
    at = np.array([-1.0, 0.0, 1.0, 2.0])
    x, y = c * at - s, s * at + c
    values = np.stack([x**3, x**2 * y, x * y**2, y**3]).T @ poly.T
    turned = np.linalg.inv(np.vander(at, 4)) @ values
    lead = np.where(turned[0] != 0.0, turned[0], 1e-300)
    companion = np.zeros((len(poly), 3, 3))
    companion[:, 0] = -(turned[1:] / lead).T
    companion[:, 1, 0] = companion[:, 2, 1] = 1.0
    finite = np.isfinite(turned).all(axis=0, keepdims=True).T
    roots = np.linalg.eigvals(np.nan_to_num(companion)).astype(complex)
    real = finite & (np.abs(roots.imag) <= REAL * (1.0 + np.abs(roots)))
    return np.asarray(np.arctan2(s * roots.real + c, c * roots.real - s)), real


def _unit(matrices: Mat3, real: BoolArray) -> Mat3:
    size: FloatArray = np.sqrt(np.sum(matrices**2, axis=(-2, -1), keepdims=True))
    real = real & (size.reshape(real.shape) > 0.0)
    return np.asarray(np.where(real[..., None, None], matrices / np.where(size > 0.0, size, 1.0), np.nan))
