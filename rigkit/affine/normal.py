"""Surface normals from affinities, with their predicted covariance.

Source: L. Hajder, "Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations", and D. Barath, J.
Molnar, L. Hajder, "Optimal Surface Normal from Affine Transformation" (VISAPP 2015), which the paper means by its
optimal normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.affine.components import blocks, finite
from rigkit.affine.surface import linear_gauge
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Normals, as_floats
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import angle_between

NORMAL_METHODS = ("optimal", "fne", "nullvector")

MIN_PARALLAX = 1e-9
"""Smallest |h| / |J2|, about the angle between the two viewing rays in radians: below, it is rounding."""

RELATIVE_RIDGE = 1e-2
"""Relative variance added across h, where epipolar lines have errors of their own: affinities that fulfil the epipolar
geometry by construction have no other there, and must not be divided by it."""


@dataclass(frozen=True, eq=False, slots=True)
class NormalEstimate:
    """Normals of N points with their predicted error.

    Attributes
    ----------
    normals : (N, 3) unit, facing camera 1, in the frame of the Jacobians; NaN where invalid.
    valid : (N,) bool.
    covariance : (N, 3, 3) of the unit normal to first order (rank 2, tangent to the sphere), rad^2; NaN where unknown.
    sigma_rad : (N,) predicted rms angle; NaN where unknown. For small errors it is the root of the covariance's trace;
        where the geometry hardly determines the normal it stays an angle, of about a radian, and does not run away.
    """

    normals: Normals
    valid: BoolArray
    covariance: FloatArray
    sigma_rad: FloatArray


def normals_from_affines(
    J1: FloatArray, J2: FloatArray, A21: Affines, *, method: str = "optimal", covariance: FloatArray | None = None
) -> tuple[Normals, BoolArray]:
    """Return unit normals (N, 3) that face camera 1, and where they are valid.

    Parameters
    ----------
    J1, J2 : (N, 2, 3) d pixel / d point of both images in one frame (`pair_projection_jacobians`); the normals' frame.
    A21 : (N, 2, 2) affinities, NaN where there is none.
    method : "optimal": the normal whose affinity is nearest to A21. "fne" and "nullvector" are for comparison: they
        agree where A21 fulfils the epipolar geometry and are worse elsewhere.
    covariance : (N, 4, 4) of vec(A21), for "optimal": nearest then means by Mahalanobis distance.

    Notes
    -----
    Optimal: with A(n) = G - h y^T, n ~ J1^T y + d, the minimum of |A(n) - A|_F is y = (G - A)^T h / (h . h).
    Undefined without parallax, h = 0 (the point lies at the epipole, or the cameras coincide): NaN and invalid.

    Raises InputError for arrays of other shapes, or that are no numbers.
    """
    J1, J2, A21 = _matching(J1, J2, A21)
    if method == "optimal":
        out = np.empty((len(A21), 3))
        for block in blocks(len(A21)):
            gauge = None if covariance is None else covariance[block]
            out[block] = _optimal(J1[block], J2[block], A21[block], gauge)
    elif method == "fne":
        out = _towards_camera(_fast(J1, J2, A21), J1)
    elif method == "nullvector":
        out = _towards_camera(_null_vector(J1, J2, A21), J1)
    else:
        raise InputError(f"normal method '{method}' is unknown; known: {', '.join(NORMAL_METHODS)}")
    valid = finite(out)
    out[~valid] = np.nan
    return out, valid


def _matching(J1: FloatArray, J2: FloatArray, A21: Affines) -> tuple[FloatArray, FloatArray, Affines]:
    """Return the three as float64; raises InputError where they are not of the same N points."""
    J1, J2, A21 = as_floats(J1, (2, 3), "J1"), as_floats(J2, (2, 3), "J2"), as_floats(A21, (2, 2), "A21")
    n = len(J1)
    if J1.shape != (n, 2, 3) or J2.shape != (n, 2, 3) or A21.shape != (n, 2, 2):
        raise InputError(
            f"normals: J1 and J2 of shape (N, 2, 3) and A21 of (N, 2, 2) are needed, got {J1.shape}, {J2.shape} and "
            f"{A21.shape}"
        )
    return J1, J2, A21


def estimate_normals(
    J1: FloatArray,
    J2: FloatArray,
    A21: Affines,
    *,
    covariance: FloatArray | None = None,
    sigma_A: FloatArray | None = None,
    weighted: bool = False,
    geometry: FloatArray | None = None,
) -> NormalEstimate:
    """Return the optimal normals with their covariance.

    Parameters
    ----------
    J1, J2, A21 : as in `normals_from_affines`.
    covariance : (N, 4, 4) of vec(A21), from `Affinities.covariance`; or
    sigma_A : (N,) or a scalar, standard deviation of independent entries of A21.
    weighted : use `covariance` also to weight the fit.
    geometry : (N, 3, 3) share of corners and pose, from `geometry_covariance`; it is added.
    """
    if covariance is None and sigma_A is not None:
        variance = np.broadcast_to(np.asarray(sigma_A, dtype=np.float64) ** 2, (len(A21),))
        covariance = variance[:, None, None] * np.eye(4)
    fit = covariance if weighted else None
    normals, valid = normals_from_affines(J1, J2, A21, covariance=fit)
    if covariance is None:
        return NormalEstimate(normals, valid, np.full((len(A21), 3, 3), np.nan), np.full(len(A21), np.nan))
    by_affinity = _solution(linear_gauge(J1, J2).h, fit)
    spread_y = by_affinity @ covariance @ np.swapaxes(by_affinity, -1, -2)
    spread = normal_covariance(J1, J2, normals, covariance, weighted=weighted)
    square = _rms_angle(J1, normals, spread_y) ** 2
    if geometry is not None:
        spread = spread + geometry
        square = square + np.trace(geometry, axis1=-2, axis2=-1)
    return NormalEstimate(normals, valid, spread, np.sqrt(square))


def normal_covariance(
    J1: FloatArray, J2: FloatArray, normals: Normals, covariance: FloatArray, *, weighted: bool = False
) -> FloatArray:
    """Return the covariance (N, 3, 3) of the unit normal from that of vec(A21), (N, 4, 4), to first order.

    Notes
    -----
    dy = -dA^T h / (h . h) and dn = (I - n n^T) J1^T dy / |J1^T y + d|. The error is thus the affinity's error along the
    epipolar line over |h| = |d pixel2 / d range|: small baselines, far planes and points near the epipole are lost.
    """
    gauge = linear_gauge(J1, J2)
    by_affinity = -_solution(gauge.h, covariance if weighted else None)
    # In the gauge n . d = 1 the normal has length 1 / |n . d|.
    facing = np.abs(np.sum(normals * gauge.d, axis=-1))[:, None, None]
    tangent = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    by = facing * (tangent @ np.swapaxes(J1, -1, -2) @ by_affinity)
    return np.asarray(by @ covariance @ np.swapaxes(by, -1, -2))


def _rms_angle(J1: FloatArray, normals: Normals, spread_y: FloatArray) -> FloatArray:
    """Return the rms angle (N,) to the normals of four points one (scaled) standard deviation of y away.

    Two-dimensional sigma points y +- sqrt(2) L e_i with weight 1/4: exact to first order, and bounded beyond.
    """
    ray = np.cross(J1[:, 0], J1[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        gauge = normals / np.sum(normals * ray, axis=-1, keepdims=True)
        first = np.sqrt(spread_y[:, 0, 0])
        cross = np.where(first > 0.0, spread_y[:, 0, 1] / np.where(first > 0.0, first, 1.0), 0.0)
        second = np.sqrt(np.maximum(spread_y[:, 1, 1] - cross * cross, 0.0))
    total = np.zeros(len(normals))
    for a, b in ((first, cross), (np.zeros_like(first), second)):
        step = np.sqrt(2.0) * (J1[:, 0] * a[:, None] + J1[:, 1] * b[:, None])
        total += angle_between(gauge, gauge + step) ** 2 + angle_between(gauge, gauge - step) ** 2
    return np.asarray(np.sqrt(total / 4.0))


def _optimal(J1: FloatArray, J2: FloatArray, A21: Affines, covariance: FloatArray | None) -> Normals:
    J1, J2, A21 = _planar(J1), _planar(J2), _planar(A21)
    G, h, d = linear_gauge(J1, J2)
    if covariance is not None:
        y = np.einsum("nij,nj->ni", _solution(h, covariance), (G - A21).reshape(-1, 4))
        return _from_gauge(J1, d, y)
    hx, hy = h[:, 0], h[:, 1]
    j = J2.reshape(len(J2), 6)
    size = sum(j[:, k] * j[:, k] for k in range(6))
    with np.errstate(divide="ignore", invalid="ignore"):
        square = hx * hx + hy * hy
        inverse = 1.0 / np.where(square > MIN_PARALLAX**2 * size, square, np.nan)
        px, py = hx * inverse, hy * inverse
        y = np.empty(h.shape)
        y[:, 0] = (G[:, 0, 0] - A21[:, 0, 0]) * px + (G[:, 1, 0] - A21[:, 1, 0]) * py
        y[:, 1] = (G[:, 0, 1] - A21[:, 0, 1]) * px + (G[:, 1, 1] - A21[:, 1, 1]) * py
    return _from_gauge(J1, d, y)


def _planar(array: FloatArray) -> FloatArray:
    """Return the same array with its first axis contiguous in memory, so that single components are."""
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(array, 0, -1)), -1, 0)


def _from_gauge(J1: FloatArray, d: FloatArray, y: FloatArray) -> Normals:
    """Return -unit(J1^T y + d): in this gauge n . d = 1, so its opposite faces camera 1."""
    out = np.empty((len(y), 3))
    for i in range(3):
        out[:, i] = -(J1[:, 0, i] * y[:, 0] + J1[:, 1, i] * y[:, 1] + d[:, i])
    out /= np.sqrt(out[:, 0] ** 2 + out[:, 1] ** 2 + out[:, 2] ** 2)[:, None]
    return out


def _solution(h: FloatArray, covariance: FloatArray | None) -> FloatArray:
    """Return W (N, 2, 4) with y = W vec(G - A).

    Without a covariance y is (G - A)^T h / (h . h). With one, the part of G - A across h, which is zero in truth,
    corrects y by what the two parts' errors have in common (generalised least squares, safe where that part has no
    error).
    """
    square = np.sum(h * h, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.einsum("ni,jl->njil", h / square[:, None], np.eye(2)).reshape(-1, 2, 4)
        if covariance is None:
            return np.asarray(along)
        across = np.einsum("ni,jl->njil", np.stack([-h[:, 1], h[:, 0]], -1) / square[:, None], np.eye(2))
    across = across.reshape(-1, 2, 4)
    half = covariance @ np.swapaxes(across, -1, -2)
    common = along @ half
    own = across @ half
    trace = np.trace(along @ covariance @ np.swapaxes(along, -1, -2), axis1=-2, axis2=-1)
    total = own + (RELATIVE_RIDGE * trace)[:, None, None] * np.eye(2)
    good = finite(total) & (np.linalg.det(np.nan_to_num(total)) > 0.0)
    out = np.full(along.shape, np.nan)
    gain = np.swapaxes(np.linalg.solve(total[good], np.swapaxes(common[good], -1, -2)), -1, -2)
    out[good] = along[good] - gain @ across[good]
    return out


def _fast(J1: FloatArray, J2: FloatArray, A21: Affines) -> Normals:
    """FNE: n = (a4 w1 - a1 w4) x (a3 w2 - a2 w3), uses two combinations of the four equations a_i n.w5 = n.w_i."""
    w1, w2, w3, w4, _ = _minors(J1, J2)
    a1, a2, a3, a4 = (A21.reshape(-1, 4)[:, i : i + 1] for i in range(4))
    return np.asarray(np.cross(a4 * w1 - a1 * w4, a3 * w2 - a2 * w3))


def _null_vector(J1: FloatArray, J2: FloatArray, A21: Affines) -> Normals:
    """Smallest singular vector of the rows a_i w5 - w_i."""
    w = _minors(J1, J2)
    rows = A21.reshape(-1, 4)[:, :, None] * w[4][:, None, :] - np.stack(w[:4], axis=1)
    normal = np.einsum("nki,nkj->nij", rows, rows)
    good = finite(normal)
    out = np.full((len(A21), 3), np.nan)
    out[good] = np.linalg.eigh(normal[good])[1][..., 0]
    return out


def _minors(J1: FloatArray, J2: FloatArray) -> tuple[FloatArray, ...]:
    u1, v1, u2, v2 = J1[:, 0], J1[:, 1], J2[:, 0], J2[:, 1]
    return tuple(np.cross(a, b) for a, b in ((v1, u2), (u2, u1), (v1, v2), (v2, u1), (v1, u1)))


def _towards_camera(normals: Normals, J1: FloatArray) -> Normals:
    with np.errstate(divide="ignore", invalid="ignore"):
        facing = np.sum(normals * np.cross(J1[:, 0], J1[:, 1]), axis=-1, keepdims=True)
        return np.asarray(-np.sign(facing) * normals / np.linalg.norm(normals, axis=-1, keepdims=True))
