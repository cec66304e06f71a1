"""Uncertainty of a calibrated projection over the image, in pixels.

Propagating the covariance of the parameters alone overestimates it: a shift of the principal point is almost
equivalent to a rotation of the camera, and a camera calibrated from boards alone has a free rotation. So for far points
a change dk of the parameters is combined with the rotation W that compensates it best where the boards were,

    dq = (Q - R (R^T R)^-1 R^T Q) dk,      Q = d q / d k,      R = d q / d W,

with sums over the corners used. For points at a known distance the uncertainty is that of the image of a point fixed to
the boards: the mean motion of the boards is the motion (W, T) that goes with dk, and

    dq = d q / d k  dk + d q / d x (W x x + T)

has the covariance M F M^T, with F the joint covariance of (k, W, T) (`Calibration.frame_covariance`). Model inadequacy
(`departures`, `series`) is added to both: almost zero where many boards were and the model fits.

Reference: D. Kogan, mrcal, "Projection uncertainty" and "Projection differences" (the same mean over the frames and the
same rotation; here in closed form).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rigkit.calibration.certainty.departures import Departures, information_of_lens, rotation_derivatives
from rigkit.calibration.certainty.series import TERMS, Remainder
from rigkit.calibration.result import Calibration, CalibrationCorners, Rival
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    Mat3,
    Pixels,
    Rays,
    scaled_pinv,
    spread_indices,
    symmetric_pinv,
)
from rigkit.geometry.rotation import exp_so3

CORNERS = 400
"""Number of corners, spread over all views, at which the uncertainty is evaluated."""
FOLLOWED = 1e-6
"""Relative singular value up to which a combination of parameters has no effect at the corners and is not changed."""


@dataclass(frozen=True, eq=False, slots=True)
class Uncertainty:
    """Covariance of the projection.

    Attributes
    ----------
    pixels : (..., 2) where it is evaluated.
    covariance : (..., 2, 2) px^2, NaN where the pixel has no ray.
    valid : (...,) whether the pixel has a ray.
    """

    pixels: Pixels
    covariance: FloatArray
    valid: BoolArray

    @property
    def worst_px(self) -> FloatArray:
        """Standard deviation in the worst direction, (...,) px, NaN where invalid."""
        return worst_direction(self.covariance)


def projection_uncertainty(calibration: Calibration, pixels: Pixels, *, range_mm: float = np.inf) -> Uncertainty:
    """Return the uncertainty of the projection at `pixels` (..., 2) for points at the distance `range_mm`: at infinity
    (default) after the free rotation, at a finite distance relative to the boards."""
    pixels = np.asarray(pixels, dtype=np.float64)
    rays, valid = calibration.camera.unproject(pixels)
    flat = np.where(valid[..., None], rays, [0.0, 0.0, 1.0]).reshape(-1, 3)
    far = FarProjection.of(calibration)
    if np.isinf(range_mm):
        found = far.covariance(flat)
    else:
        known = far.departures.noise.widening**2 * far.departures.near_covariance
        found = _propagated(known, projection_design(calibration.near, calibration.along(flat, range_mm), 1.0))
        found += far.beyond_model(Along.of(calibration.camera, flat))
    covariance = found.reshape(*valid.shape, 2, 2)
    return Uncertainty(pixels, np.where(valid[..., None, None], covariance, np.nan), valid)


def worst_direction(covariance: FloatArray) -> FloatArray:
    """Return the standard deviation in the worst direction (...,) for covariances (..., 2, 2)."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.asarray(np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b)))


@dataclass(frozen=True, eq=False, slots=True)
class Along:
    """Rays (M, 3) with their pixels (M, 2) in a camera, NaN outside its field of view, and their `projection_design`
    (2, P + 3, M)."""

    rays: Rays
    pixels: Pixels
    design: FloatArray

    @classmethod
    def of(cls, camera: Camera, rays: Rays) -> Along:
        pixels, design = _projected(camera, rays, np.inf)
        return cls(rays, pixels, design)

    def __getitem__(self, chosen: BoolArray) -> Along:
        """Return the same of the rays chosen."""
        return Along(self.rays[chosen], self.pixels[chosen], self.design[..., chosen])


@dataclass(frozen=True, eq=False, kw_only=True)
class FarProjection:
    """Uncertainty of the projection of points at infinity, after the rotation that compensates a change of the
    parameters best where the boards were.

    Attributes
    ----------
    calibration, camera : the calibration and its camera.
    correlation, sigmas : (P, P) and (P,) of its parameters, given the departures.
    rays_valid : (M,) which of up to 400 corners, spread over all views, have a ray.
    corners : the projection along those N rays.
    compensation : (3, P) the rotation that compensates a step of one standard deviation of each parameter.
    departures, departure_compensation : model inadequacy of the lens, and (3, J) the rotations that compensate
        displacements.
    corners_left : (2, P + J, N) displacement of the corners by such steps and displacements after these rotations.
    rivals : cameras of other models, each with the change of the parameters (P,) that fits `camera` to it where boards
        were, and the rotation of its rays (3, 3). Elsewhere the two differ.
    remainder : truncation error of the lens's series; None if the model is no series.
    """

    calibration: Calibration
    camera: Camera
    correlation: FloatArray
    sigmas: FloatArray
    rays_valid: BoolArray
    corners: Along
    compensation: FloatArray
    departures: Departures
    departure_compensation: FloatArray
    corners_left: FloatArray
    rivals: tuple[tuple[Rival, FloatArray, Mat3], ...]
    remainder: Remainder | None

    @classmethod
    def of(cls, calibration: Calibration, *, from_boards: bool = False) -> FarProjection:
        """Return that of a calibration. With `from_boards` the rays are those to the solved corners, which all have to
        project: this saves the unprojection of the pixels."""
        camera, corners = calibration.camera, calibration.corners
        chosen = _spread(corners)
        if from_boards and calibration.pupil is None:
            points = corners.in_cam(chosen)
            rays, valid = points / np.sqrt((points * points).sum(axis=-1, keepdims=True)), np.ones(len(points), bool)
        else:
            rays, valid = camera.unproject(corners.pixels[chosen])
            rays = rays[valid]
        p = camera.parameters.size
        at, departures = Along.of(camera, rays), Departures.of(calibration)
        # Parameters have different units; in standard deviations they are comparable.
        known = departures.noise.widening**2 * departures.near_covariance[:p, :p]
        sigmas = np.sqrt(np.maximum(np.diag(known), 0.0))
        left = np.concatenate([sigmas[:, None] * at.design[:, :p], departures.unabsorbed(at.pixels, at.design)], axis=1)
        turned = at.design[:, p:]
        compensation = _compensating_rotations(turned, left)
        left -= compensation.T @ turned
        safe = np.where(sigmas > 0.0, sigmas, 1.0)
        correlation = known / np.outer(safe, safe)
        return cls(
            calibration=calibration,
            camera=camera,
            correlation=correlation,
            sigmas=sigmas,
            rays_valid=valid,
            corners=at,
            compensation=compensation[:, :p],
            departures=departures,
            departure_compensation=compensation[:, p:],
            corners_left=left,
            rivals=tuple((one, *step_to_lens(camera, one.camera, rays, sigmas)) for one in calibration.rivals),
            remainder=Remainder.of(calibration, known, compensation[:, :p] / safe),
        )

    def covariance(self, rays: FloatArray) -> FloatArray:
        """Return the covariance (M, 2, 2) of the projection along rays (M, 3)."""
        at, p = Along.of(self.camera, rays), len(self.sigmas)
        own = _after_rotation(self.sigmas[:, None] * at.design[:, :p], self.compensation, at.design[:, p:])
        return _propagated(self.correlation, own) + self.beyond_model(at)

    def beyond_model(self, at: Along) -> FloatArray:
        """Return the part of the covariance (M, 2, 2) from model inadequacy and rivals."""
        return self._beyond(self.unabsorbed(at), at) + self._rival_excess(at.rays)

    def _rival_excess(self, rays: Rays) -> FloatArray:
        """Return the excess (M, 2, 2) of the rivals' own covariances along `rays` (M, 3) over that of the chosen lens,
        weighted by their probabilities (Buckland et al. 1997, eq. 9): if a rival is right, its covariance is.

        It is zero where boards were; elsewhere a model with more parameters is less certain. Longer series of the same
        model are left out: the `remainder` stands for their further terms.
        """
        out = np.zeros((len(rays), 2, 2))
        if not self._others:
            return out
        own, *others = self._alone
        known = own.along(rays)
        for (rival, turn), other in zip(self._others, others, strict=True):
            more = other.along(rays @ turn.T) - known
            # Outside the field of view of either lens the excess is zero.
            values, axes = np.linalg.eigh(np.where(np.isfinite(more).all(axis=(1, 2), keepdims=True), more, 0.0))
            out += rival.likely * (axes * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(axes, 1, 2)
        return out

    @property
    def _others(self) -> list[tuple[Rival, Mat3]]:
        """Rivals that are not of the same series with another number of terms."""
        same = self.camera.model if len(self.camera.series) >= TERMS else ""
        return [(rival, turn) for rival, _, turn in self.rivals if rival.camera.model != same]

    @cached_property
    def _alone(self) -> list[_Alone]:
        """The lens and its rivals, each with its own covariance."""
        rays = self.corners.rays
        lenses = [(self.camera, np.eye(3)), *((rival.camera, turn) for rival, turn in self._others)]
        sigma_px = self.departures.noise.between_images_px
        return [_Alone.of(self.calibration, camera, turn, rays, sigma_px) for camera, turn in lenses]

    def _beyond(self, left: FloatArray, at: Along) -> FloatArray:
        out = _propagated(self.departures.covariance, left)
        for shift_px in self.shifts_px(at):
            out += shift_px[:, :, None] * shift_px[:, None, :]
        return out

    def unabsorbed(self, at: Along) -> FloatArray:
        """Return the displacements less the part that parameters and rotation absorb, (2, J, M) px."""
        left = self.departures.unabsorbed(at.pixels, at.design)
        return _after_rotation(left, self.departure_compensation, at.design[:, len(self.sigmas) :])

    def shifts_px(self, at: Along) -> list[FloatArray]:
        """Return the displacements (M, 2) px of the rays in other lenses that may be the true one: each rival, with the
        chosen lens fitted to it where boards were, times the root of its probability, and the truncated terms of the
        series."""
        out, p = [], len(self.sigmas)
        for rival, step, turn in self.rivals:
            there, seen = rival.camera.project(at.rays @ turn.T)
            moved = np.where(seen[:, None], there - at.pixels, 0.0) - np.einsum("ipm,p->mi", at.design[:, :p], step)
            out.append(np.sqrt(rival.likely) * moved)
        if self.remainder is not None:
            out += list(self.remainder.shifts_px(at.design))
        return out

    @cached_property
    def at_corners_px(self) -> FloatArray:
        """Standard deviation in the worst direction, (M,) px, at the corners; NaN where one has no ray."""
        beyond = self._beyond(self.corners_left[:, len(self.sigmas) :], self.corners)
        return self._over_all(self._corners_of_parameters + beyond)

    @property
    def of_parameters_px(self) -> FloatArray:
        """The same (M,) without model inadequacy."""
        return self._over_all(self._corners_of_parameters)

    @cached_property
    def _corners_of_parameters(self) -> FloatArray:
        return _propagated(self.correlation, self.corners_left[:, : len(self.sigmas)])

    def _over_all(self, covariance: FloatArray) -> FloatArray:
        out = np.full(len(self.rays_valid), np.nan)
        out[self.rays_valid] = worst_direction(covariance)
        return out

    @property
    def typical_px(self) -> float:
        """Standard deviation where the boards were: rms over the corners; infinite if none has a ray."""
        known = self.at_corners_px[np.isfinite(self.at_corners_px)]
        return float(np.sqrt(np.mean(known**2))) if known.size else float("inf")

    @property
    def worst_px(self) -> float:
        """Standard deviation at the worst corner."""
        known = self.at_corners_px[np.isfinite(self.at_corners_px)]
        return float(known.max()) if known.size else float("inf")


@dataclass(frozen=True, eq=False, slots=True)
class _Alone:
    """A lens with the covariance (P, P) of its own parameters for the same corners, and the rotations (3, P) that
    compensate its parameters best where boards were."""

    camera: Camera
    covariance: FloatArray
    compensation: FloatArray

    @classmethod
    def of(cls, calibration: Calibration, camera: Camera, turn: Mat3, rays: Rays, sigma_px: float) -> _Alone:
        """Return that of a `camera` with corners of `sigma_px`; `rays` (N, 3) are those to corners in the calibrated
        camera, and `turn` rotates them to those of `camera`."""
        # A rival may leave a parameter undetermined.
        covariance = scaled_pinv(information_of_lens(calibration, camera, turn))
        design, p = projection_design(camera, rays @ turn.T), len(covariance)
        return cls(camera, covariance * sigma_px**2, _compensating_rotations(design[:, p:], design[:, :p]))

    def along(self, rays: Rays) -> FloatArray:
        """Return the covariance (M, 2, 2) of the projection along rays (M, 3) of the lens itself."""
        design, p = projection_design(self.camera, rays), len(self.covariance)
        return _propagated(self.covariance, _after_rotation(design[:, :p], self.compensation, design[:, p:]))


def _compensating_rotations(turned: FloatArray, moved: FloatArray) -> FloatArray:
    """Return the rotations (3, K) that compensate displacements `moved` (2, K, M) of M pixels best; `turned` (2, 3, M)
    is d pixel / d rotation."""
    square = (turned @ np.swapaxes(turned, 1, 2)).sum(axis=0)
    return np.asarray(symmetric_pinv(square) @ (turned @ np.swapaxes(moved, 1, 2)).sum(axis=0))


def _after_rotation(moved: FloatArray, compensation: FloatArray, turned: FloatArray) -> FloatArray:
    """Return displacements (2, K, M) after the rotations `compensation` (3, K) that compensate them."""
    return np.asarray(moved - np.einsum("wk,iwm->ikm", compensation, turned))


def _propagated(parameters: FloatArray, design: FloatArray) -> FloatArray:
    """Return covariances (M, 2, 2) from that of K parameters (K, K) and the derivatives `design` (2, K, M) by them."""
    moved = parameters @ design
    covariance = np.empty((design.shape[-1], 2, 2))
    for i, j in ((0, 0), (0, 1), (1, 1)):
        covariance[:, i, j] = covariance[:, j, i] = np.einsum("kn,kn->n", design[i], moved[j])
    return covariance


def projection_design(camera: Camera, rays: FloatArray, range_mm: float = np.inf) -> FloatArray:
    """Return d pixel / d (k, W, T), (2, P + 6, M), along rays (M, 3); at infinity, where a translation has no effect,
    (2, P + 3, M)."""
    return _projected(camera, rays, range_mm)[1]


def _projected(camera: Camera, rays: FloatArray, range_mm: float) -> tuple[Pixels, FloatArray]:
    """Return the pixels (M, 2), NaN outside the field of view, and `projection_design`."""
    # Unknowns first, pixels last: one matrix product for each coordinate.
    p = camera.parameters.size
    count = p + 3 if np.isinf(range_mm) else p + 6
    design, by_x = np.zeros((2, count, len(rays))), np.empty((2, 3, len(rays)))
    ray = np.ascontiguousarray(rays.T)
    u, v, valid = camera.derivatives(ray[0], ray[1], ray[2], by_x, design[:, :p])
    pixels = np.stack([u, v], axis=-1)
    if not valid.all():
        pixels[~valid] = np.nan
    design[:, p : p + 3] = rotation_derivatives(ray, by_x)
    if count > p + 3:
        design[:, p + 3 :] = by_x / range_mm
    return pixels, design


def step_to_lens(camera: Camera, other: Camera, rays: Rays, sigmas: FloatArray) -> tuple[FloatArray, Mat3]:
    """Return the change of the parameters (P,) of a camera that fits it to another one along `rays` (N, 3), and the
    rotation other_from_camera (3, 3) of the rays fitted with it; `sigmas` (P,) scale the parameters. A moving pupil
    moves along the axis of its own lens: its terms are compared directly."""
    if isinstance(camera, NearCamera) and isinstance(other, NearCamera):
        step, turn = step_to_lens(camera.lens, other.lens, rays, sigmas[: camera.lens.parameters.size])
        return np.append(step, other.pupil - camera.pupil), turn
    pixels, valid = camera.project(rays)
    rays, pixels = rays[valid], pixels[valid]
    turn = best_rotation(rays, pixels, np.ones(len(rays)), other)
    there, seen = other.project(rays @ turn.T)
    # Parameters and rotation are correlated: both are fitted together.
    rows = projection_design(camera, rays[seen]).transpose(2, 0, 1).reshape(-1, len(sigmas) + 3)
    rows[:, :-3] *= sigmas
    size = np.linalg.norm(rows, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    step = np.linalg.lstsq(rows / size, (there - pixels)[seen].reshape(-1), rcond=FOLLOWED)[0] / size
    return sigmas * step[:-3], turn @ exp_so3(-step[-3:])


def _spread(corners: CalibrationCorners) -> IntArray:
    """Return the indices of up to 400 kept corners, with the views ordered by their place in the image: the choice does
    not depend on the order of the views."""
    chosen = np.flatnonzero(corners.kept)
    view = corners.view[chosen]
    shown, first = np.unique(view, return_index=True)
    rank = np.zeros(len(corners.count), np.int64)
    rank[shown[np.lexsort(corners.pixels[chosen[first]].T)]] = np.arange(len(shown))
    chosen = chosen[np.argsort(rank[view], kind="stable")]
    return chosen[spread_indices(len(chosen), CORNERS)]


def uncertainty_map(calibration: Calibration, *, grid: tuple[int, int] = (40, 30)) -> Uncertainty:
    """Return the uncertainty for far points at `grid` (columns, rows) pixels, as arrays (rows, columns, ...)."""
    return projection_uncertainty(calibration, grid_pixels(calibration.camera.size_px, grid))
