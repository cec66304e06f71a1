"""The solvers of minimal.c in numpy: by singular values, and by the eigenvectors of the multiplication by x.

H. Stewenius, C. Engels, D. Nister, "Recent developments on direct relative orientation", 2006. The coefficients of the
cubics are found by evaluating the constraints at fixed random places, not by expanding them.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3
from rigkit.relative_pose.solvers.pose import essential_nearest

REAL = 1e-8
"""An eigenvalue with a larger imaginary part (relative) is complex."""

_CUBIC = ("300", "210", "201", "120", "111", "102", "030", "021", "012", "003")
_LOWER = ("200", "110", "101", "020", "011", "002", "100", "010", "001", "000")
_DEGREES3 = np.array([list(map(int, term)) for term in _CUBIC + _LOWER])
"""Exponents of x, y, z in the twenty monomials: the cubic ones first."""

_DEGREES2 = np.array([[3, 0], [2, 1], [1, 2], [0, 3], [2, 0], [1, 1], [0, 2], [1, 0], [0, 1], [0, 0]])

_OFTEN = np.array([1.0, 3.0, 3.0, 1.0, 3.0, 6.0, 3.0, 3.0, 3.0, 1.0])
"""How many of the 27 products of three of (x, y, 1) are each of the ten monomials."""

_PRODUCTS = np.array([[0, 1, 4, 1, 2, 5, 4, 5, 7], [1, 2, 5, 2, 3, 6, 5, 6, 8], [4, 5, 7, 5, 6, 8, 7, 8, 9]])
"""Which monomial is the product of one of (x, y, 1), by row, and each pair of them."""


def essential_from_five_rows(rows: FloatArray) -> Mat3:
    """Return up to ten E (B, 10, 3, 3) of rows (B, 5, 9)."""
    basis = _null_space(rows, 4)
    coefficients = _constraint_coefficients(basis, _DEGREES3)
    ok = np.linalg.cond(coefficients[:, :, :10]) < 1e13
    reduced = np.zeros((len(rows), 10, 10))
    reduced[ok] = np.linalg.solve(coefficients[ok][:, :, :10], coefficients[ok][:, :, 10:])
    # Multiplication by x of the monomials x2 xy xz y2 yz z2 x y z 1: the first six become cubic and are reduced.
    action = np.zeros((len(rows), 10, 10))
    action[:, :6] = -reduced[:, :6]
    action[:, [6, 7, 8, 9], [0, 1, 2, 6]] = 1.0
    values, vectors = np.linalg.eig(action)
    one = vectors[:, 9, :]
    scale = np.where(np.abs(one) > 1e-12, one, np.nan)
    xyz = np.swapaxes(vectors[:, 6:9] / scale[:, None, :], 1, 2)
    real = ok[:, None] & (np.abs(values.imag) <= REAL * (1.0 + np.abs(values))) & np.isfinite(xyz).all(axis=2)
    weights = np.concatenate([xyz.real, np.ones((*xyz.shape[:2], 1))], axis=2)
    return _unit(np.einsum("bsk,bkij->bsij", np.nan_to_num(weights), basis), real)


def essential_from_six_rows(rows: FloatArray) -> Mat3:
    """Return the E (B, 1, 3, 3) of rows (B, 6, 9), two affine correspondences: the essential matrix nearest to the one
    whose monomials violate the ten cubics least.

    The monomials are scaled so that the answer does not depend on the choice of the basis: all 27 products of three of
    the unknowns, of which ten differ, have the length one together.
    """
    basis = _null_space(rows, 3)
    coefficients = _constraint_coefficients(basis, _DEGREES2) / np.sqrt(_OFTEN)
    monomials = np.linalg.svd(coefficients)[2][:, -1] / np.sqrt(_OFTEN)
    # With noise they are no products: the weights whose products come nearest.
    weights = np.linalg.svd(monomials[:, _PRODUCTS])[0][:, :, 0]
    return essential_nearest(np.einsum("bk,bkij->bij", weights, basis))[:, None]


def _constraint_coefficients(basis: FloatArray, degrees: FloatArray) -> FloatArray:
    """Return coefficients (B, 10, M) on the monomials `degrees` (M, k) of 2 E E^T E - tr(E E^T) E = 0 and det E = 0."""
    unknowns = degrees.shape[1]
    places = np.random.default_rng(5).uniform(-1.0, 1.0, (2 * len(degrees), unknowns))
    monomials = np.prod(places[:, None, :] ** degrees, axis=2)
    weights = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    E = np.einsum("pk,bkij->bpij", weights, basis)
    EEt = E @ np.swapaxes(E, -1, -2)
    trace = np.trace(EEt, axis1=-2, axis2=-1)[..., None, None]
    cubic = (2.0 * EEt @ E - trace * E).reshape(*E.shape[:2], 9)
    values = np.concatenate([cubic, np.linalg.det(E)[..., None]], axis=2)
    return np.asarray(np.einsum("mp,bpc->bcm", np.linalg.pinv(monomials), values))


def _null_space(rows: FloatArray, dimension: int) -> FloatArray:
    """Return an orthonormal basis (B, dimension, 3, 3) of what the rows (B, 9 - dimension, 9) leave."""
    vt = np.linalg.svd(rows, full_matrices=True)[2]
    return np.asarray(vt[:, 9 - dimension :].reshape(-1, dimension, 3, 3))


def _unit(matrices: Mat3, real: BoolArray) -> Mat3:
    size: FloatArray = np.sqrt(np.sum(matrices**2, axis=(-2, -1), keepdims=True))
    real = real & (size.reshape(real.shape) > 0.0)
    return np.asarray(np.where(real[..., None, None], matrices / np.where(size > 0.0, size, 1.0), np.nan))
