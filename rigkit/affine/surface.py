"""The affinity between two cameras of a surface with a given normal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import Affines, BoolArray, FloatArray, Normals


class LinearGauge(NamedTuple):
    """A = G - h y^T for the surface n ~ J1^T y + d, which makes the affinity linear in y (2,).

    Attributes
    ----------
    G : (..., 2, 2) affinity of the surface perpendicular to the ray of camera 1.
    h : (..., 2) d pixel2 / d range1, px/mm, along the epipolar line of image 2. Zero at the epipole.
    d : (..., 3) unit viewing ray of camera 1.
    """

    G: Affines
    h: FloatArray
    d: FloatArray


def linear_gauge(J1: FloatArray, J2: FloatArray) -> LinearGauge:
    """Return the gauge n . d = 1 from d pixel / d point (..., 2, 3) of both images, in one frame, for central cameras.

    Notes
    -----
    d = unit(grad u1 x grad v1), G = J2 J1^T (J1 J1^T)^-1, h = J2 d. Equivalent to the form of Molnar and Chetverikov
    that Hajder uses (tests/affine/test_surface.py, with an erratum).
    """
    ux, uy, uz = (J1[..., 0, i] for i in range(3))
    vx, vy, vz = (J1[..., 1, i] for i in range(3))
    d = np.empty((*J1.shape[:-2], 3))
    d[..., 0], d[..., 1], d[..., 2] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    with np.errstate(divide="ignore", invalid="ignore"):
        d /= np.sqrt(d[..., 0] ** 2 + d[..., 1] ** 2 + d[..., 2] ** 2)[..., None]
        uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
        inverse = 1.0 / (uu * vv - uv * uv)
    G = np.empty((*J1.shape[:-2], 2, 2))
    h = np.empty((*J1.shape[:-2], 2))
    for row in (0, 1):
        jx, jy, jz = (J2[..., row, i] for i in range(3))
        ju, jv = jx * ux + jy * uy + jz * uz, jx * vx + jy * vy + jz * vz
        G[..., row, 0] = (ju * vv - jv * uv) * inverse
        G[..., row, 1] = (jv * uu - ju * uv) * inverse
        h[..., row] = jx * d[..., 0] + jy * d[..., 1] + jz * d[..., 2]
    return LinearGauge(G, h, d)


def affines_from_normals(J1: FloatArray, J2: FloatArray, normals: Normals) -> tuple[Affines, BoolArray]:
    """Return A21 (..., 2, 2) of surfaces with `normals` (..., 3; of any length and sign), and which are valid.

    Invalid (NaN) where camera 1 sees the surface edge-on. J1, J2: d pixel / d point (..., 2, 3) in the normals' frame.
    """
    G, h, d = linear_gauge(J1, J2)
    n = np.asarray(normals, dtype=np.float64)
    uu, uv, vv = (np.sum(J1[..., i, :] * J1[..., j, :], axis=-1) for i, j in ((0, 0), (0, 1), (1, 1)))
    nu, nv, nd = np.sum(J1[..., 0, :] * n, axis=-1), np.sum(J1[..., 1, :] * n, axis=-1), np.sum(n * d, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / ((uu * vv - uv * uv) * nd)
        y = np.stack([(nu * vv - nv * uv) * scale, (nv * uu - nu * uv) * scale], axis=-1)
        A21 = G - h[..., :, None] * y[..., None, :]
    valid = np.isfinite(A21).all(axis=(-2, -1))
    return np.where(valid[..., None, None], A21, np.nan), valid
