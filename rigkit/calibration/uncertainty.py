"""How far a calibrated projection may be off, over the image, in pixels.

The covariance of the parameters alone says too much: a changed principal point and a turned camera are the same image
of the world, and a camera calibrated from boards alone has a free rotation. At infinity a change dk of the parameters
goes with the rotation W that hides it best where the boards were,

    dq = (Q - R (R^T R)^-1 R^T Q) dk,      Q = d q / d k,      R = d q / d W,

sums over the corners used. Of points at a known distance what counts is where a point that is fixed to the boards
appears: the boards' solved motions, averaged, are the motion of the world (W, T) that goes with dk, and

    dq = d q / d k  dk + d q / d x (W x x + T)

has the covariance M F M^T, with F the joint covariance of (k, W, T) (`Calibration.frame_covariance`).

Reference: D. Kogan, mrcal, "Projection uncertainty" and "Projection differences" (the mean over the frames and the
rotation that is taken out are the same; here in closed form).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels, Points

CORNERS = 400
"""So many corners, spread over all views, are enough to see how sure the projection is where the boards were."""


@dataclass(frozen=True, eq=False, slots=True)
class Uncertainty:
    """Covariance of the projection.

    Attributes
    ----------
    pixels : (..., 2) where.
    covariance : (..., 2, 2) px^2, NaN where the pixel has no ray.
    valid : (...,)
    """

    pixels: Pixels
    covariance: FloatArray
    valid: BoolArray

    @property
    def worst_px(self) -> FloatArray:
        """Standard deviation in the worst direction, (...,) px, NaN where invalid."""
        return worst_direction(self.covariance)


def projection_uncertainty(calibration: Calibration, pixels: Pixels, *, range_mm: float = np.inf) -> Uncertainty:
    """Return the uncertainty of the projection at `pixels` (..., 2) of points `range_mm` away: at infinity (default)
    after the rotation that boards leave open, nearer relative to the boards."""
    pixels = np.asarray(pixels, dtype=np.float64)
    rays, valid = calibration.camera.unproject(pixels)
    flat = np.where(valid[..., None], rays, [0.0, 0.0, 1.0]).reshape(-1, 3)
    if np.isinf(range_mm):
        found = FarProjection.of(calibration).covariance(flat)
    else:
        found = _propagated(calibration.frame_covariance, projection_design(calibration.camera, flat, range_mm))
    covariance = found.reshape(*valid.shape, 2, 2)
    return Uncertainty(pixels, np.where(valid[..., None, None], covariance, np.nan), valid)


def worst_direction(covariance: FloatArray) -> FloatArray:
    """Return the standard deviation in the worst direction (...,) of covariances (..., 2, 2)."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.asarray(np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b)))


@dataclass(frozen=True, eq=False)
class FarProjection:
    """How sure a calibration is of the projection of points at infinity, after the rotation that hides a change of the
    parameters best where the boards were.

    Attributes
    ----------
    camera : the camera.
    correlation, sigmas : (P, P) and (P,) of its parameters.
    rays_valid : (M,) which of up to 400 corners, spread over all views, have a ray.
    corners : (2, P + 3, N) `projection_design` along the rays of those that have one.
    hides : (3, P) the rotation that hides a step of one standard deviation of each parameter.
    """

    camera: Camera
    correlation: FloatArray
    sigmas: FloatArray
    rays_valid: BoolArray
    corners: FloatArray
    hides: FloatArray

    @classmethod
    def of(cls, calibration: Calibration, points_in_cam: Points | None = None) -> FarProjection:
        """Return it for a calibration. `points_in_cam` (N, 3) are the boards' corners in the camera frame, of the
        corners used, where they are known: it saves the way back from the pixels."""
        camera = calibration.camera
        if points_in_cam is None:
            kept = np.concatenate([view.kept for view in calibration.views])
            pixels = np.concatenate([view.pixels for view in calibration.views])[kept]
            rays, valid = camera.unproject(pixels[_spread(len(pixels))])
            rays = rays[valid]
        else:
            points = points_in_cam[_spread(len(points_in_cam))]
            rays, valid = points / np.linalg.norm(points, axis=-1, keepdims=True), np.ones(len(points), dtype=bool)
        p = camera.parameters.size
        # Parameters have units of their own: in standard deviations they can be compared.
        sigmas = np.sqrt(np.maximum(np.diag(calibration.covariance), 0.0))
        design = projection_design(camera, rays)
        there = design.transpose(1, 0, 2).reshape(p + 3, -1)
        hides = np.asarray(
            np.linalg.lstsq(there[p:].T, (sigmas[:, None] * there[:p]).T, rcond=None)[0], dtype=np.float64
        )
        safe = np.where(sigmas > 0.0, sigmas, 1.0)
        return cls(camera, calibration.covariance / np.outer(safe, safe), sigmas, valid, design, hides)

    def covariance(self, rays: FloatArray) -> FloatArray:
        """Return the covariance (M, 2, 2) of the projection along rays (M, 3)."""
        return self._covariance(projection_design(self.camera, rays))

    @cached_property
    def at_corners_px(self) -> FloatArray:
        """Standard deviation in the worst direction, (M,) px, at the corners; NaN where one has no ray."""
        out = np.full(len(self.rays_valid), np.nan)
        out[self.rays_valid] = worst_direction(self._covariance(self.corners))
        return out

    @property
    def usual_px(self) -> float:
        """Standard deviation where the boards were: rms over the corners; infinite where none has a ray."""
        known = self.at_corners_px[np.isfinite(self.at_corners_px)]
        return float(np.sqrt(np.mean(known**2))) if known.size else float("inf")

    @property
    def worst_px(self) -> float:
        """The same of the worst corner."""
        known = self.at_corners_px[np.isfinite(self.at_corners_px)]
        return float(known.max()) if known.size else float("inf")

    def _covariance(self, design: FloatArray) -> FloatArray:
        p = len(self.sigmas)
        left = self.sigmas[:, None] * design[:, :p] - np.einsum("wp,iwm->ipm", self.hides, design[:, p:])
        return _propagated(self.correlation, left)


def _propagated(parameters: FloatArray, design: FloatArray) -> FloatArray:
    """Return the covariances (M, 2, 2) of what has the derivatives `design` (2, K, M) by K unknowns."""
    moved = parameters @ design
    covariance = np.empty((design.shape[-1], 2, 2))
    for i, j in ((0, 0), (0, 1), (1, 1)):
        covariance[:, i, j] = covariance[:, j, i] = np.einsum("kn,kn->n", design[i], moved[j])
    return covariance


def projection_design(camera: Camera, rays: FloatArray, range_mm: float = np.inf) -> FloatArray:
    """Return d pixel / d (k, W, T), (2, P + 6, M), along rays (M, 3); at infinity the world's shift shows nothing, and
    it is (2, P + 3, M)."""
    # Unknowns first, pixels last: one matrix product for each coordinate.
    p = camera.parameters.size
    count = p + 3 if np.isinf(range_mm) else p + 6
    design, by_x = np.zeros((2, count, len(rays))), np.empty((2, 3, len(rays)))
    ray = np.ascontiguousarray(rays.T)
    camera.derivatives(ray[0], ray[1], ray[2], by_x, design[:, :p])
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        design[:, p + k] = ray[i] * by_x[:, j] - ray[j] * by_x[:, i]
    if count > p + 3:
        design[:, p + 3 :] = by_x / range_mm
    return design


def _spread(count: int) -> IntArray:
    return np.linspace(0, count - 1, min(CORNERS, count)).astype(np.int64)


def uncertainty_map(
    calibration: Calibration, *, grid: tuple[int, int] = (40, 30), range_mm: float = np.inf
) -> Uncertainty:
    """Return the uncertainty over the image at `grid` (columns, rows) pixels, as arrays (rows, columns, ...)."""
    width, height = calibration.camera.size_px
    u, v = np.meshgrid(np.linspace(0.0, width - 1.0, grid[0]), np.linspace(0.0, height - 1.0, grid[1]))
    return projection_uncertainty(calibration, np.stack([u, v], axis=-1), range_mm=range_mm)
