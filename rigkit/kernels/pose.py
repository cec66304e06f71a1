"""Calls of the kernels in five_point.c and six_point.c, minimal solvers of the relative pose for many samples, and of
those in pose_quality.c and pose_minimum.c, which evaluate and refine hypotheses with many matches.

Five equations (five points, or one affine correspondence and two points): ten cubics in three unknowns, solved by a
polynomial in one of them (Nister, "An efficient solution to the five-point relative pose problem", 2004). Six (two
affine correspondences): ten cubics in two unknowns, linear in their ten monomials (Eichhardt and Barath; Raposo and
Barreto).
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Mat3
from rigkit.kernels import kernels
from rigkit.kernels.calls import make_struct
from rigkit.kernels.declarations import header

NO_MEMORY = header().constants["NO_MEMORY"]


def residuals(packed: FloatArray, E21: Mat3) -> FloatArray:
    """Return the distances (H, N) in sigmas of the matches `packed` (18, N) from hypotheses (H, 3, 3)."""
    return np.asarray(kernels().residuals(packed, E21))


def qualities(packed: FloatArray, E21: Mat3, noise: float) -> FloatArray:
    """Return the sums (H,) of the marginal quality at a noise level of hypotheses (H, 3, 3)."""
    return np.asarray(kernels().qualities(packed, E21, noise))


def qualities_ahead(packed: FloatArray, R: FloatArray, t: FloatArray, noise: float, sigmas: float) -> FloatArray:
    """Return the sums (H,) with cheirality for rotations (H, 2, 3, 3) and directions (H, 3); see pose_quality.c."""
    return np.asarray(kernels().qualities_ahead(packed, R, t, noise, sigmas))


def improve(
    packed: FloatArray, R: FloatArray, t: FloatArray, noise: float, free: IntArray, max_steps: int, settled_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Return the local optima of the quality at a noise level, rotations (H, 3, 3) and directions (H, 3)."""
    R, t = np.array(R, np.float64, order="C"), np.array(t, np.float64, order="C")
    kernels().improve(packed, R, t, noise, free, max_steps, settled_rad)
    return R, t


def minimise(
    packed: FloatArray,
    affine: FloatArray,
    which: IntArray,
    point_weights: FloatArray,
    loss: tuple[int, float],
    free: IntArray,
    R: FloatArray,
    t: FloatArray,
    max_iterations: int,
    tolerance: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, int, bool]:
    """Return R, t, residuals (M,), Jacobian (M, 5), weights (M,), iterations, and whether the last step was small.

    `affine` (25, K) are the affinities of the matches `which` (K,), see pose_minimum.c; `loss` is its number (0 none, 1
    Cauchy, 2 marginal) and its scale; `free` are the indices of the free parameters.
    """
    problem = make_struct(
        "pose_problem_t",
        packed=packed,
        affine=affine,
        point_weights=point_weights,
        which=which,
        free=free,
        loss=loss[0],
        max_iterations=max_iterations,
        scale=loss[1],
        tolerance=tolerance,
    )
    R, t = np.array(R, np.float64, order="C"), np.array(t, np.float64)
    iterations, r, jacobian, weights = kernels().minimise(problem, R, t)
    if iterations == NO_MEMORY:
        raise MemoryError
    return R, t, r, jacobian, weights, abs(iterations), iterations > 0 or not len(free)


def five_rows(rows: FloatArray) -> Mat3:
    """Return up to ten E (B, 10, 3, 3) of `rows` (B, 5, 9), padded with NaN."""
    return np.asarray(kernels().five_rows(rows))


def six_rows(rows: FloatArray) -> Mat3:
    """Return the E (B, 1, 3, 3) of `rows` (B, 6, 9), nearest to the matrix with the least squares monomials of the ten
    cubics.

    The monomials are scaled so that the result does not depend on the choice of the basis: the vector of all 27
    products of three of the unknowns, of which ten differ, has length one.
    """
    return np.asarray(kernels().six_rows(rows))
