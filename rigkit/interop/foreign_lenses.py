"""Projections of other programs' lens models that rigkit lacks, for refits by `nearest_camera_of`."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Pixels, Rays
from rigkit.interop.nearest import Lens

AXIS_TANGENT = 1e-9
"""Tangent or angle below which a ray counts as the axis."""


def fov_lens(core: FloatArray, w: float) -> Lens:
    """Return the FOV model of `core` fx, fy, cx, cy: r_d = atan(2 r tan(w / 2)) / w.

    Reference: F. Devernay and O. Faugeras, "Straight lines have to be straight", 2001; COLMAP's FOV, Kalibr's fov.
    """

    def project(rays: Rays) -> tuple[Pixels, BoolArray]:
        place, seen = _perspective(rays)
        radius = np.linalg.norm(place, axis=-1, keepdims=True)
        scale = 2.0 * np.tan(0.5 * w) / w
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(radius > AXIS_TANGENT, np.arctan(2.0 * radius * np.tan(0.5 * w)) / (w * radius), scale)
        return _pixels(core, ratio * place), seen

    return project


def unified_brown_lens(core: FloatArray, xi: float, d: FloatArray) -> Lens:
    """Return the unified model with Brown's distortion of k1, k2, p1, p2 on top of its sphere (Mei; Kalibr's
    omni-radtan, OpenCV's omnidir)."""

    def project(rays: Rays) -> tuple[Pixels, BoolArray]:
        depth = rays[:, 2:] + xi
        # For xi > 1 only the near side of the sphere is visible.
        seen = depth[:, 0] > max(AXIS_TANGENT, xi - 1.0 / xi if xi > 1.0 else 0.0)
        place = rays[:, :2] / np.where(seen[:, None], depth, 1.0)
        return _pixels(core, _brown(place, d)), seen

    return project


def brown_prism_lens(core: FloatArray, d: FloatArray) -> Lens:
    """Return OpenCV's model of twelve terms: k1, k2, p1, p2, k3 ... k6, s1 ... s4 (thin prism)."""

    def project(rays: Rays) -> tuple[Pixels, BoolArray]:
        place, seen = _perspective(rays)
        return _pixels(core, _brown(place, d)), seen

    return project


def fisheye_prism_lens(core: FloatArray, radial: FloatArray, d: FloatArray) -> Lens:
    """Return an equidistant fisheye with radial terms, and then p1, p2 and thin prism s1 ... s4 (`d`).

    COLMAP's RAD_TAN_THIN_PRISM_FISHEYE, which is Project Aria's FISHEYE624: theta (1 + k1 theta^2 + ...) is distorted.
    """
    p1, p2, *prism = d.tolist()

    def project(rays: Rays) -> tuple[Pixels, BoolArray]:
        place, seen = _equidistant(rays)
        theta2 = np.sum(place**2, axis=-1)
        place = place * (1.0 + theta2 * np.polynomial.polynomial.polyval(theta2, radial))[:, None]
        return _pixels(core, place + _tangential(place, p2, p1) + _prism(place, prism)), seen

    return project


def thin_prism_fisheye_lens(core: FloatArray, d: FloatArray) -> Lens:
    """Return COLMAP's THIN_PRISM_FISHEYE: k1, k2, p1, p2, k3, k4, sx1, sy1, all of the equidistant angle."""
    k1, k2, p1, p2, k3, k4, sx, sy = d.tolist()

    def project(rays: Rays) -> tuple[Pixels, BoolArray]:
        place, seen = _equidistant(rays)
        theta2 = np.sum(place**2, axis=-1)
        radial = theta2 * np.polynomial.polynomial.polyval(theta2, [k1, k2, k3, k4])
        prism = np.array([sx, sy]) * theta2[:, None]
        return _pixels(core, place * (1.0 + radial)[:, None] + _tangential(place, p1, p2) + prism), seen

    return project


def cahvor_lens(core: FloatArray, angles: FloatArray, r: FloatArray) -> Lens:
    """Return mrcal's CAHVOR of `angles` alpha and beta. A ray is shifted perpendicular to the axis o = (sin alpha cos
    beta, sin beta, cos alpha cos beta) by mu = r0 + r1 tau + r2 tau^2 times its distance from it, where tau is the
    squared tangent of its angle to o.

    Reference: Y. Yakimovsky and R. Cunningham, "A system for extracting three-dimensional measurements from a stereo
    pair of TV cameras", 1978; D. Gennery, 2001; the axis by mrcal's documentation.
    """
    alpha, beta = angles.tolist()
    axis = np.array([np.sin(alpha) * np.cos(beta), np.sin(beta), np.cos(alpha) * np.cos(beta)])

    def project(rays: Rays) -> tuple[Pixels, BoolArray]:
        along = rays @ axis
        seen = along > AXIS_TANGENT
        along = np.where(seen, along, 1.0)
        tau = 1.0 / along**2 - 1.0
        mu = np.polynomial.polynomial.polyval(tau, r)
        moved = rays + mu[:, None] * (rays - along[:, None] * axis)
        seen &= moved[:, 2] > AXIS_TANGENT
        return _pixels(core, moved[:, :2] / np.where(seen, moved[:, 2], 1.0)[:, None]), seen

    return project


def _perspective(rays: Rays) -> tuple[FloatArray, BoolArray]:
    seen = rays[:, 2] > AXIS_TANGENT
    return rays[:, :2] / np.where(seen, rays[:, 2], 1.0)[:, None], seen


def _equidistant(rays: Rays) -> tuple[FloatArray, BoolArray]:
    """Return theta (x, y) / r of all rays; only COLMAP itself excludes angles of 90 degrees and more."""
    r = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.arctan2(r, rays[:, 2])
    ratio = np.where(r > AXIS_TANGENT, theta / np.where(r > AXIS_TANGENT, r, 1.0), 1.0)
    return rays[:, :2] * ratio[:, None], np.ones(len(rays), dtype=bool)


def _brown(place: FloatArray, d: FloatArray) -> FloatArray:
    """Return the distorted points; d has k1, k2, p1, p2, and optionally k3 ... k6, s1 ... s4."""
    k1, k2, p1, p2, k3, k4, k5, k6, *prism = np.concatenate([d, np.zeros(12 - d.size)]).tolist()
    t = np.sum(place**2, axis=-1)
    radial = (1.0 + t * (k1 + t * (k2 + t * k3))) / (1.0 + t * (k4 + t * (k5 + t * k6)))
    return np.asarray(radial[:, None] * place + _tangential(place, p1, p2) + _prism(place, prism))


def _tangential(place: FloatArray, p1: float, p2: float) -> FloatArray:
    x, y = place.T
    t = x**2 + y**2
    return np.stack([2.0 * p1 * x * y + p2 * (t + 2.0 * x**2), p1 * (t + 2.0 * y**2) + 2.0 * p2 * x * y], axis=-1)


def _prism(place: FloatArray, s: list[float]) -> FloatArray:
    t = np.sum(place**2, axis=-1)
    return np.stack([t * (s[0] + t * s[1]), t * (s[2] + t * s[3])], axis=-1)


def _pixels(core: FloatArray, place: FloatArray) -> Pixels:
    return core[:2] * place + core[2:4]
