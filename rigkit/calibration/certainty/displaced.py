"""A calibrated camera with its model inadequacy as further parameters.

So everything that propagates the covariance of a camera's parameters (certificates, planes, clouds) includes the
departures of the lens from its model (`departures`). The image of the camera is displaced by

    q' = q + sum_m c_m sum_j E_jm b_j(q),      q = the model's pixel,

with the displacements b_j and a few modes E (J, M) of one standard deviation each. The amounts c, all zero, are
parameters after those of the model. The model's parameters change with each mode as a fit to the images would change
them.

A displaced lens without symmetry has no optical axis. Its frame is the one in which the calibrated model is closest to
it where boards were: so a single camera rotates with each mode by the rotation that compensates it best. In a rig the
mounts change instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigkit.calibration.certainty.departures import Departures
from rigkit.calibration.certainty.uncertainty import Along, FarProjection
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera, image_center
from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import BoolArray, Coordinates, FloatArray, Mat3, Projected
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import exp_so3, left_jacobian, skew
from rigkit.kernels.departures import DISPLACEMENTS, displacement, displacements

MODES_GRID = (24, 18)
"""Columns and rows of pixels at which modes are compared with the total uncertainty."""
MAX_LEFT_OUT = 0.02
"""Modes that together are less than this part of the variance at every pixel are left out: 1 % of a sigma."""
SOFTEST, HARDEST, PENALTIES = 1e-6, 1.0, 19
"""Range and number of the ridge penalties tried, relative to the largest singular value, for a rival's amounts."""
SLOPE_STEP_PX = 1e-2
"""Step of central differences of displacements, which vary over hundreds of pixels: exact to eight digits."""
MAX_INVERSION_ROUNDS, ROUNDING_PX = 20, 1e-10
"""Rounds of the fixed-point iteration that inverts displacements: each multiplies the error by their slope, 0.01."""


@dataclass(frozen=True, eq=False, slots=True)
class DisplacedCamera(Camera):
    """A camera whose image is displaced by amounts of modes.

    Attributes
    ----------
    lens : the camera without displacements; `parameters` are its parameters, then the M amounts.
    modes : (J, M) px, the modes in terms of the J displacements, which are constant beyond the corners of the image.
    turns : (3, M) rad, rotation of the rays in front of the lens with each mode; None: no rotation.
    """

    lens: Camera
    modes: FloatArray
    turns: FloatArray | None = None
    _own: Camera = field(init=False, repr=False)
    _amounts: FloatArray = field(init=False, repr=False)
    _turned: Mat3 | None = field(init=False, repr=False)

    model: ClassVar[str] = "displaced"

    def _prepare(self) -> None:
        count = self.lens.parameters.size
        object.__setattr__(self, "_own", self.lens.with_parameters(self.parameters[:count]))
        amounts = self.parameters[count:]
        object.__setattr__(self, "_amounts", self.modes @ amounts)
        turned = None if self.turns is None or not amounts.any() else exp_so3(self.turns @ amounts)
        object.__setattr__(self, "_turned", turned)

    def with_parameters(self, parameters: ArrayLike) -> Self:
        return type(self)(self.size_px, np.asarray(parameters, dtype=np.float64), self.lens, self.modes, self.turns)

    def parameter_names(self) -> tuple[str, ...]:
        return (*self.lens.parameter_names(), *(f"departure {m + 1}" for m in range(self.modes.shape[1])))

    @property
    def max_angle_rad(self) -> float:
        return self.lens.max_angle_rad

    def _basis(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Return the displacements (2, J, N) at pixels; pixels outside the circle through the image's corners are moved
        to it."""
        pixels, centre = np.stack([u, v], axis=-1), image_center(self.size_px)
        off = pixels - centre
        reach = 0.5 * np.hypot(*self.size_px) / np.maximum(np.linalg.norm(off, axis=-1), 1.0)
        return displacements(centre + np.minimum(reach, 1.0)[:, None] * off, self.size_px)

    def _displacement(self, u: FloatArray, v: FloatArray) -> FloatArray:
        if not self._amounts.any():
            return np.zeros((2, len(u)))
        return displacement(u, v, self._amounts, self.size_px)

    def _turn(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return points rotated into the frame of the lens."""
        if self._turned is None:
            return x, y, z
        x, y, z = self._turned @ np.stack([x, y, z])
        return x, y, z

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> Projected:
        u, v, valid = self._own._project(*self._turn(x, y, z))
        du, dv = self._displacement(u, v)
        return u + du, v + dv, valid

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        off = np.zeros((2, len(u)))
        for _ in range(MAX_INVERSION_ROUNDS):
            before, off = off, self._displacement(u - off[0], v - off[1])
            if not np.nanmax(np.abs(off - before), initial=0.0) > ROUNDING_PX:
                break
        x, y, z, valid = self._own._unproject(u - off[0], v - off[1])
        if self._turned is not None:
            x, y, z = self._turned.T @ np.stack([x, y, z])
        return x, y, z, valid

    def _derivatives(
        self, at: Coordinates, d_pixels_d_point: FloatArray, d_pixels_d_parameters: FloatArray | None
    ) -> Projected:
        count = self.lens.parameters.size
        of_lens = None if d_pixels_d_parameters is None else d_pixels_d_parameters[:, :count]
        x, y, z = self._turn(*at)
        u, v, valid = self._own._derivatives((x, y, z), d_pixels_d_point, of_lens)
        of_amounts = None if d_pixels_d_parameters is None else d_pixels_d_parameters[:, count:]
        if of_amounts is not None:
            of_amounts[:] = 0.0
            if self.turns is not None:
                by_turn = d_pixels_d_point.transpose(2, 0, 1) @ -skew(np.stack([x, y, z], axis=-1))
                by_amount = left_jacobian(self.turns @ self.parameters[count:]) @ self.turns
                of_amounts[:] = (by_turn @ by_amount).transpose(1, 2, 0)
        if self._turned is not None:
            d_pixels_d_point[:] = self._turned.T @ d_pixels_d_point
        if self._amounts.any():
            along_u, along_v = (
                (self._displacement(u + s, v + t) - self._displacement(u - s, v - t)) / (2.0 * SLOPE_STEP_PX)
                for s, t in ((SLOPE_STEP_PX, 0.0), (0.0, SLOPE_STEP_PX))
            )
            for block in (d_pixels_d_point, d_pixels_d_parameters):
                if block is not None:
                    block += along_u[:, None] * block[0] + along_v[:, None] * block[1]
        if of_amounts is not None:
            of_amounts += np.swapaxes(np.swapaxes(self._basis(u, v), 1, 2) @ self.modes, 1, 2)
        du, dv = self._displacement(u, v)
        return u + du, v + dv, valid


def lens_of(camera: Camera) -> Camera:
    """Return a camera without displacements."""
    return camera._own if isinstance(camera, DisplacedCamera) else camera


@dataclass(frozen=True, eq=False, slots=True)
class LensModes:
    """Model inadequacy of a lens, in M independent modes of one standard deviation each.

    Attributes
    ----------
    modes : (J, M) px, the amounts of the displacements.
    moves : (G, M) error of all unknowns with each mode.
    means : (M,) expected amount of each mode, in standard deviations about zero.
    turns : (3, M) rad, rotation of the rays of a single camera with each mode; None: no rotation.
    """

    modes: FloatArray
    moves: FloatArray
    means: FloatArray
    turns: FloatArray | None = None


def uncertain_camera(
    calibration: Calibration, *, quoted: bool = True, near: bool = False, modes: LensModes | None = None
) -> UncertainCamera:
    """Return a calibrated camera and its covariance, with its model inadequacy as further parameters where that is
    significant; with a model that fits and boards all over the image it is not, and the camera is the calibration's.

    The covariance is widened if `quoted`, else that of Student's t, for callers that use the calibration's degrees of
    freedom. The camera is for far points; with `near` for points in mm, a `NearCamera` where the pupil moves, as the
    errors of lens and pupil are correlated. `modes` are those of `lens_modes`, where they are known already.
    """
    pupil = calibration.pupil if near else None
    departures = Departures.of(calibration)
    known = departures.near_covariance * (departures.noise.widening**2 if quoted else 1.0)
    p = calibration.camera.parameters.size if pupil is None else -6
    modes = lens_modes(calibration, near=near) if modes is None else modes
    (camera,), covariance, expected = with_modes((calibration.camera,), known[:p, :p], (modes,))
    return UncertainCamera(camera if pupil is None else NearCamera.of(camera, pupil.terms), covariance, expected)


def lens_modes(calibration: Calibration, *, near: bool = False) -> LensModes:
    """Return the model inadequacy of a calibrated lens, with the errors of its parameters, and with `near` those of its
    pupil."""
    far = FarProjection.of(calibration)
    changes = far.departures.parameter_changes
    modes, means = significant_modes(far)
    if near:
        changes = np.concatenate([changes, far.departures.pupil_changes])
    return LensModes(modes, -changes @ modes, means, -far.departure_compensation @ modes)


def with_modes(
    cameras: Sequence[Camera], covariance: FloatArray, modes: Sequence[LensModes]
) -> tuple[tuple[Camera, ...], FloatArray, FloatArray]:
    """Return cameras with the amounts of their modes as further parameters, the covariance of the errors of all
    unknowns about zero, and the part (T, T) of it that is the square of the error expected: the parameters of each
    camera, then the rest, in the order of `covariance` (G, G), which is that without modes. Without any `modes` cameras
    and covariance are returned unchanged.
    """
    if not modes:
        return tuple(cameras), covariance, np.zeros_like(covariance)
    out: list[Camera] = []
    known, amounts, end = [], [], 0
    for camera, own in zip(cameras, modes, strict=True):
        count = own.modes.shape[1]
        known.append(np.arange(end, end + camera.parameters.size))
        amounts.append(np.arange(end + camera.parameters.size, end + camera.parameters.size + count))
        end = int(known[-1][-1]) + 1 + count
        out.append(with_amounts(camera, own.modes, own.turns))
    known.append(np.arange(end, end + len(covariance) - sum(len(own) for own in known)))
    at = np.concatenate(known)
    size = len(at) + sum(len(own) for own in amounts)
    whole, expected = np.zeros((size, size)), np.zeros(size)
    whole[np.ix_(at, at)] = covariance
    for where, own in zip(amounts, modes, strict=True):
        move = np.zeros((size, len(where)))
        move[at], move[where] = own.moves, np.eye(len(where))
        mean = move @ own.means
        # Modes of two lenses are independent about their means.
        whole += move @ move.T + np.outer(expected, mean) + np.outer(mean, expected)
        expected += mean
    return tuple(out), whole, np.outer(expected, expected)


def covariance_of_modes(modes: Sequence[LensModes], count: int) -> FloatArray:
    """Return what the modes of lenses add to the covariance (count, count) about zero of the unknowns."""
    out, expected = np.zeros((count, count)), np.zeros(count)
    for own in modes:
        mean = own.moves @ own.means
        # Modes of two lenses are independent about their means.
        out += own.moves @ own.moves.T + np.outer(expected, mean) + np.outer(mean, expected)
        expected += mean
    return out


def with_amounts(camera: Camera, modes: FloatArray, turns: FloatArray | None = None) -> Camera:
    """Return a camera with the amounts of `modes` (J, M) as further parameters; unchanged if there are none."""
    parameters = np.append(camera.parameters, np.zeros(modes.shape[1]))
    return DisplacedCamera(camera.size_px, parameters, camera, modes, turns) if modes.shape[1] else camera


def significant_modes(far: FarProjection) -> tuple[FloatArray, FloatArray]:
    """Return independent modes (J, M) px of displacements, one standard deviation about zero each, and their means
    (M,): those of the model inadequacy, rivals included, that are significant against the uncertainty of the
    parameters."""
    pixels = grid_pixels(far.camera.size_px, MODES_GRID).reshape(-1, 2)
    rays, valid = far.camera.unproject(pixels)
    rays = rays[valid]
    at = Along.of(far.camera, rays)
    whole = np.sqrt(np.trace(far.covariance(rays), axis1=1, axis2=2))
    known = np.isfinite(whole) & (whole > 0.0)
    if not known.any():
        return np.zeros((DISPLACEMENTS, 0)), np.zeros(0)
    # In units of the total sigma, so that places count alike.
    at, whole = at[known], whole[known]
    relative = far.unabsorbed(at).transpose(1, 2, 0) / whole[:, None]
    fields = relative.reshape(DISPLACEMENTS, -1)
    covariance = far.departures.covariance.copy()
    for shift_px in far.shifts_px(at):
        amounts = _amounts_like(far, at, whole, fields, shift_px)
        covariance += np.outer(amounts, amounts)
    values, axes = np.linalg.eigh(covariance)
    sizes = np.sqrt(np.maximum(values, 0.0))
    root = axes * sizes
    flat = root.T @ fields
    # From the smallest on: parts of the variance add up until they matter at some pixel.
    turn = np.linalg.eigh(flat @ flat.T)[1]
    share = ((turn.T @ flat) ** 2).reshape(DISPLACEMENTS, -1, 2).sum(axis=-1)
    matters = np.cumsum(share, axis=0).max(axis=1) > MAX_LEFT_OUT
    means = turn.T @ (axes.T @ far.departures.mean / np.maximum(sizes, np.finfo(float).tiny))
    return np.asarray((root @ turn)[:, matters]), np.asarray(means[matters])


def _amounts_like(
    far: FarProjection, at: Along, whole: FloatArray, fields: FloatArray, shift_px: FloatArray
) -> FloatArray:
    """Return the amounts (J,) with which the displaced camera, its parameters adapted, moves M rays closest to
    `shift_px` (M, 2) px, in units of `whole` (M,) px. `fields` (J, 2 M) are the displacements, in these units, less the
    part that parameters and a rotation absorb.

    At first order, huge displacements that parameters and a rotation compensate almost completely could represent any
    difference, but the exact camera would not. So the rotation is fitted to zero and large amounts are penalised
    (ridge); the penalty is the one with which the exact displaced camera has the least error.
    """
    p = len(far.sigmas)
    turned = np.einsum("wj,iwm->jmi", far.departure_compensation, at.design[:, p:]) / whole[:, None]
    values, axes = np.linalg.eigh(far.departures.covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    rows = np.concatenate([fields, turned.reshape(DISPLACEMENTS, -1)], axis=1).T @ root
    wanted = np.concatenate([(shift_px / whole[:, None]).ravel(), np.zeros(2 * len(at.rays))])
    left, size, right = np.linalg.svd(rows, full_matrices=False)
    best, amounts = float((wanted**2).sum()), np.zeros(DISPLACEMENTS)
    for penalty in size[0] * np.geomspace(SOFTEST, HARDEST, PENALTIES):
        tried = root @ (right.T @ (size / (size**2 + penalty**2) * (left.T @ wanted)))
        parameters = np.append(far.camera.parameters - far.departures.parameter_changes @ tried, tried)
        try:
            moved = DisplacedCamera(far.camera.size_px, parameters, far.camera, np.eye(DISPLACEMENTS))
            shown, valid = moved.project(at.rays)
        except InputError:
            continue
        # A ray that leaves the moved camera's field is not moved: rounding decides which rays are at the rim.
        off = ((np.where(valid[:, None], shown, at.pixels) - at.pixels - shift_px) / whole[:, None]).ravel()
        error = float((off**2).sum())
        if error < best:
            best, amounts = error, tried
    return amounts
