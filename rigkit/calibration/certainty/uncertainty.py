"""How far a calibrated projection may be off, over the image, in pixels.

The covariance of the parameters alone says too much: a changed principal point and a turned camera are the same image
of the world, and a camera calibrated from boards alone has a free rotation. At infinity a change dk of the parameters
goes with the rotation W that hides it best where the boards were,

    dq = (Q - R (R^T R)^-1 R^T Q) dk,      Q = d q / d k,      R = d q / d W,

sums over the corners used. Of points at a known distance what counts is where a point that is fixed to the boards
appears: the boards' solved motions, averaged, are the motion of the world (W, T) that goes with dk, and

    dq = d q / d k  dk + d q / d x (W x x + T)

has the covariance M F M^T, with F the joint covariance of (k, W, T) (`Calibration.frame_covariance`). To both is added
what the lens may do beyond its model (`departures`, `series`): next to nothing where many boards were and it fits.

Reference: D. Kogan, mrcal, "Projection uncertainty" and "Projection differences" (the mean over the frames and the
rotation that is taken out are the same; here in closed form).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rigkit.calibration.certainty.departures import Departures, information_of_lens, turned_rays
from rigkit.calibration.certainty.series import TERMS, Remainder
from rigkit.calibration.result import Calibration, CalibrationCorners, Rival
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import best_rotation
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3, Pixels, Points, Rays, scaled_pinv, symmetric_pinv
from rigkit.geometry.rotation import exp_so3, skew

CORNERS = 400
"""So many corners, spread over all views, are enough to see how sure the projection is where the boards were."""
FOLLOWED = 1e-6
"""Combinations of parameters with less than this part of the largest effect at the corners stay where they are."""


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
    far = FarProjection.of(calibration)
    if np.isinf(range_mm):
        found = far.covariance(flat)
    else:
        known = calibration.widening**2 * calibration.near_covariance
        found = _propagated(known, projection_design(calibration.near, calibration.along(flat, range_mm), 1.0))
        found += far.beyond_model(Along.of(calibration.camera, flat))
    covariance = found.reshape(*valid.shape, 2, 2)
    return Uncertainty(pixels, np.where(valid[..., None, None], covariance, np.nan), valid)


def worst_direction(covariance: FloatArray) -> FloatArray:
    """Return the standard deviation in the worst direction (...,) of covariances (..., 2, 2)."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.asarray(np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b)))


@dataclass(frozen=True, eq=False, slots=True)
class Along:
    """What a camera makes of `rays` (M, 3): their `pixels` (M, 2), NaN where it has none, and the `design`
    (2, P + 3, M) of `projection_design`."""

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
    """How sure a calibration is of the projection of points at infinity, after the rotation that hides a change of the
    parameters best where the boards were.

    Attributes
    ----------
    camera : the camera.
    correlation, sigmas : (P, P) and (P,) of its parameters.
    rays_valid : (M,) which of up to 400 corners, spread over all views, have a ray.
    corners : the projection along those N rays.
    hides : (3, P) the rotation that hides a step of one standard deviation of each parameter.
    departures, hides_departures : what the lens may do beyond its model, and (3, J) the rotations that hide that.
    corners_left : (2, P + J, N) what that leaves, at the corners, of such steps and of the displacements.
    rivals : lenses of other models, each with how the parameters (P,) follow it and the rotation of its rays (3, 3):
        where boards were it is followed, elsewhere the two go apart.
    remainder : what the lens's series leaves out; None: it is no series.
    calibration : whose it is.
    """

    calibration: Calibration
    camera: Camera
    correlation: FloatArray
    sigmas: FloatArray
    rays_valid: BoolArray
    corners: Along
    hides: FloatArray
    departures: Departures
    hides_departures: FloatArray
    corners_left: FloatArray
    rivals: tuple[tuple[Rival, FloatArray, Mat3], ...]
    remainder: Remainder | None

    @classmethod
    def of(cls, calibration: Calibration, *, from_boards: bool = False) -> FarProjection:
        """Return it for a calibration; the rays to the corners `from_boards` as they were solved, where all are known
        to project: it saves the way back from the pixels."""
        camera, corners = calibration.camera, calibration.corners
        chosen = _spread(corners)
        if from_boards and calibration.pupil is None:
            points = corners.in_cam(chosen)
            rays, valid = points / np.sqrt((points * points).sum(axis=-1, keepdims=True)), np.ones(len(points), bool)
        else:
            rays, valid = camera.unproject(corners.pixels[chosen])
            rays = rays[valid]
        p = camera.parameters.size
        # Parameters have units of their own: in standard deviations they can be compared.
        known = calibration.widening**2 * calibration.covariance
        sigmas = np.sqrt(np.maximum(np.diag(known), 0.0))
        at, departures = Along.of(camera, rays), Departures.of(calibration)
        left = np.concatenate([sigmas[:, None] * at.design[:, :p], departures.left_over(at.pixels, at.design)], axis=1)
        turned = at.design[:, p:]
        square, across = (
            (turned @ np.swapaxes(turned, 1, 2)).sum(axis=0),
            (turned @ np.swapaxes(left, 1, 2)).sum(axis=0),
        )
        hides = symmetric_pinv(square) @ across
        left -= hides.T @ turned
        safe = np.where(sigmas > 0.0, sigmas, 1.0)
        correlation = known / np.outer(safe, safe)
        return cls(
            calibration=calibration,
            camera=camera,
            correlation=correlation,
            sigmas=sigmas,
            rays_valid=valid,
            corners=at,
            hides=hides[:, :p],
            departures=departures,
            hides_departures=hides[:, p:],
            corners_left=left,
            rivals=tuple((one, *followed(camera, one.camera, rays, sigmas)) for one in calibration.rivals),
            remainder=Remainder.of(calibration, known, hides[:, :p] / safe),
        )

    def covariance(self, rays: FloatArray) -> FloatArray:
        """Return the covariance (M, 2, 2) of the projection along rays (M, 3)."""
        at = Along.of(self.camera, rays)
        return self._of_parameters(at.design) + self.beyond_model(at)

    def beyond_model(self, at: Along) -> FloatArray:
        """Return what of the covariance (M, 2, 2) is what the lens may do beyond its model."""
        return self._beyond(self.left_over(at), at) + self._less_sure(at.rays)

    def _less_sure(self, rays: Rays) -> FloatArray:
        """Return by how much (M, 2, 2) rivals know less of `rays` (M, 3) than the lens chosen: where it is a rival that
        is right, its own covariance is the true one (Buckland et al. 1997, eq. 9). Where boards were that is nothing;
        elsewhere a richer model leaves open what the chosen one takes for known. Of a series with more terms that would
        be what nobody knows of a term that is there no more than the others let expect: the `remainder` stands for it.
        """
        out = np.zeros((len(rays), 2, 2))
        if not self._others:
            return out
        own, *others = self._alone
        known = own.along(rays)
        for (rival, turn), other in zip(self._others, others, strict=True):
            more = other.along(rays @ turn.T) - known
            # As with `away`: what one of the two does not see is not compared.
            values, axes = np.linalg.eigh(np.where(np.isfinite(more).all(axis=(1, 2), keepdims=True), more, 0.0))
            out += rival.likely * (axes * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(axes, 1, 2)
        return out

    @property
    def _others(self) -> list[tuple[Rival, Mat3]]:
        """Rivals that are not the same series with other terms."""
        same = self.camera.model if len(self.camera.series) >= TERMS else ""
        return [(rival, turn) for rival, _, turn in self.rivals if rival.camera.model != same]

    @cached_property
    def _alone(self) -> list[_Alone]:
        """The lens and its rivals, each as if there were no other."""
        rays = self.corners.rays
        lenses = [(self.camera, np.eye(3)), *((rival.camera, turn) for rival, turn in self._others)]
        return [_Alone.of(self.calibration, camera, turn, rays) for camera, turn in lenses]

    def _beyond(self, left: FloatArray, at: Along) -> FloatArray:
        out = _propagated(self.departures.covariance, left)
        for away in self.away(at):
            out += away[:, :, None] * away[:, None, :]
        return out

    def left_over(self, at: Along) -> FloatArray:
        """Return what parameters and rotation leave of the displacements, (2, J, M) px."""
        left = self.departures.left_over(at.pixels, at.design)
        left -= np.einsum("wj,iwm->ijm", self.hides_departures, at.design[:, len(self.sigmas) :])
        return left

    def away(self, at: Along) -> list[FloatArray]:
        """Return how far other lenses that may be the true one project the rays elsewhere, (M, 2) px each, times the
        root of how likely they are: each rival, followed where the boards were, and the lens with the terms that its
        series leaves out."""
        out, p = [], len(self.sigmas)
        for rival, step, turn in self.rivals:
            there, seen = rival.camera.project(at.rays @ turn.T)
            moved = np.where(seen[:, None], there - at.pixels, 0.0) - np.einsum("ipm,p->mi", at.design[:, :p], step)
            out.append(np.sqrt(rival.likely) * moved)
        if self.remainder is not None:
            out += list(self.remainder.away(at.design))
        return out

    @cached_property
    def at_corners_px(self) -> FloatArray:
        """Standard deviation in the worst direction, (M,) px, at the corners; NaN where one has no ray."""
        beyond = self._beyond(self.corners_left[:, len(self.sigmas) :], self.corners)
        return self._over_all(self._corners_of_parameters + beyond)

    @property
    def of_parameters_px(self) -> FloatArray:
        """The same (M,) where the model were known to be right."""
        return self._over_all(self._corners_of_parameters)

    @cached_property
    def _corners_of_parameters(self) -> FloatArray:
        return _propagated(self.correlation, self.corners_left[:, : len(self.sigmas)])

    def _over_all(self, covariance: FloatArray) -> FloatArray:
        out = np.full(len(self.rays_valid), np.nan)
        out[self.rays_valid] = worst_direction(covariance)
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

    def _of_parameters(self, design: FloatArray) -> FloatArray:
        p = len(self.sigmas)
        left = self.sigmas[:, None] * design[:, :p] - np.einsum("wp,iwm->ipm", self.hides, design[:, p:])
        return _propagated(self.correlation, left)


@dataclass(frozen=True, eq=False, slots=True)
class _Alone:
    """A lens with the covariance (P, P) that it would have by itself for these corners, and the rotations (3, P) that
    hide its parameters best where boards were."""

    camera: Camera
    covariance: FloatArray
    hides: FloatArray

    @classmethod
    def of(cls, calibration: Calibration, camera: Camera, turn: Mat3, rays: Rays) -> _Alone:
        """Return it for a `camera` whose rays are those of the calibrated one, of which these are `rays` (N, 3) to
        corners, after a `turn`."""
        # A lens gone astray may know nothing of a parameter, or by rounding less.
        covariance = scaled_pinv(information_of_lens(calibration, camera, turn))
        sigma = calibration.sigma_px * calibration.overdispersion * calibration.widening
        design, p = projection_design(camera, rays @ turn.T), len(covariance)
        turned = design[:, p:]
        square = (turned @ np.swapaxes(turned, 1, 2)).sum(axis=0)
        hides = symmetric_pinv(square) @ (turned @ np.swapaxes(design[:, :p], 1, 2)).sum(axis=0)
        return cls(camera, covariance * sigma**2, hides)

    def along(self, rays: Rays) -> FloatArray:
        """Return the covariance (M, 2, 2) of the projection along rays (M, 3) of the lens itself."""
        design, p = projection_design(self.camera, rays), len(self.covariance)
        return _propagated(self.covariance, design[:, :p] - np.einsum("wp,iwm->ipm", self.hides, design[:, p:]))


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
    return _projected(camera, rays, range_mm)[1]


def _projected(camera: Camera, rays: FloatArray, range_mm: float) -> tuple[Pixels, FloatArray]:
    """Return the pixels (M, 2), NaN where there is none, and `projection_design`."""
    # Unknowns first, pixels last: one matrix product for each coordinate.
    p = camera.parameters.size
    count = p + 3 if np.isinf(range_mm) else p + 6
    design, by_x = np.zeros((2, count, len(rays))), np.empty((2, 3, len(rays)))
    ray = np.ascontiguousarray(rays.T)
    u, v, valid = camera.derivatives(ray[0], ray[1], ray[2], by_x, design[:, :p])
    pixels = np.stack([u, v], axis=-1)
    if not valid.all():
        pixels[~valid] = np.nan
    design[:, p : p + 3] = turned_rays(ray, by_x)
    if count > p + 3:
        design[:, p + 3 :] = by_x / range_mm
    return pixels, design


def followed(camera: Camera, other: Camera, rays: Rays, sigmas: FloatArray) -> tuple[FloatArray, Mat3]:
    """Return by how much the parameters (P,) of a camera change for it to project `rays` (N, 3) as another one does,
    and the rotation other_from_camera (3, 3) of the rays that goes with it; `sigmas` (P,) make them comparable."""
    pixels, valid = camera.project(rays)
    rays, pixels = rays[valid], pixels[valid]
    turn = best_rotation(rays, pixels, np.ones(len(rays)), other)
    there, seen = other.project(rays @ turn.T)
    # Part of that rotation may be the parameters': both are found together.
    rows = projection_design(camera, rays[seen]).transpose(2, 0, 1).reshape(-1, len(sigmas) + 3)
    rows[:, :-3] *= sigmas
    size = np.linalg.norm(rows, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    step = np.linalg.lstsq(rows / size, (there - pixels)[seen].reshape(-1), rcond=FOLLOWED)[0] / size
    return sigmas * step[:-3], turn @ exp_so3(-step[-3:])


def pose_covariance_of_lens(
    camera: Camera, covariance: FloatArray, points_in_cam: Points, origin_in_cam: FloatArray, sigma_px: FloatArray
) -> FloatArray:
    """Return the lens's share in the covariance of a pose that was found with it: (6, 6) of (w, v), R' = exp([w]x) R,
    t' = t + v, rad and mm.

    A changed lens and a moved board show one image: with dq = A dp + K dk = 0, dp = -(A^T W A)^-1 A^T W K dk.

    Parameters
    ----------
    covariance : (P, P) of the camera's parameters.
    points_in_cam, origin_in_cam, sigma_px : (N, 3) and (3,) the board's points and its origin, mm, and (N,) the
        standard deviations that weighted them.
    """
    _, _, d_pixels_d_point, by_lens = camera.project_with_jacobians(points_in_cam)
    by_pose = np.concatenate([-d_pixels_d_point @ skew(points_in_cam - origin_in_cam), d_pixels_d_point], axis=-1)
    weight, count = 1.0 / sigma_px[:, None, None], 2 * len(points_in_cam)
    step = np.linalg.lstsq((by_pose * weight).reshape(count, -1), (by_lens * weight).reshape(count, -1), rcond=None)[0]
    return np.asarray(step @ covariance @ step.T)


def _spread(corners: CalibrationCorners) -> IntArray:
    """Return the numbers of up to 400 kept corners, of views in the order of where they lie in the image: the same ones
    in whatever order the views are."""
    chosen = np.flatnonzero(corners.kept)
    view = corners.view[chosen]
    shown, first = np.unique(view, return_index=True)
    rank = np.zeros(len(corners.count), np.int64)
    rank[shown[np.lexsort(corners.pixels[chosen[first]].T)]] = np.arange(len(shown))
    chosen = chosen[np.argsort(rank[view], kind="stable")]
    return chosen[np.linspace(0, len(chosen) - 1, min(CORNERS, len(chosen))).astype(np.int64)]


def uncertainty_map(calibration: Calibration, *, grid: tuple[int, int] = (40, 30)) -> Uncertainty:
    """Return how sure far points are at `grid` (columns, rows) pixels of the image, as arrays (rows, columns, ...)."""
    width, height = calibration.camera.size_px
    u, v = np.meshgrid(np.linspace(0.0, width - 1.0, grid[0]), np.linspace(0.0, height - 1.0, grid[1]))
    return projection_uncertainty(calibration, np.stack([u, v], axis=-1))
