"""Conversion of a camera to another model, for programs that lack its model, and for comparisons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera, RadialCurve
from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.fit import nearest_camera
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import BoolArray, FloatArray, Pixels, Rays
from rigkit.core.errors import InputError
from rigkit.optim.damping import Stop

CONVERT_GRID = (64, 48)
"""Columns and rows of pixels of the source at which the two cameras are compared."""
MIN_COVERED_SAMPLES = 60
LIMITS_RAD = (np.pi, *np.radians([80.0, 70.0, 60.0, 50.0, 40.0]))
"""Angles from the axis up to which a model is fitted: the largest at which its error is small is taken."""
FOLLOWS_PX = 1.0
"""Largest error of a model that represents the lens."""
WIDE_RAD = np.radians(60.0)
"""Smaller limits are tried for perspective models of lenses that are wider than this; others are fitted everywhere."""
MAX_CONVERT_STEPS = 60
CONVERT_SETTLED = 1e-10
"""Relative decrease of the cost at which the fit stops."""
OUTSIDE_WEIGHT = 0.02
"""Weight of errors outside the outline of the calibration's corners, where the lens is extrapolated."""
ROUNDING_PX = 1e-10
"""Error at which the fit stops: rounding."""
INSIDE = 0.995
"""Part of the initial camera's field of view that is fitted: at its edge the derivatives diverge."""


@dataclass(frozen=True, eq=False, slots=True)
class Conversion:
    """A camera that replaces another one.

    Attributes
    ----------
    camera : the new camera.
    max_px, rms_px : its projection error inside the outline, where it covers the image.
    outside_px : its largest projection error outside the outline; 0 without an outline.
    covered : part of the source's pixels that it covers.
    reach_rad : largest angle from the axis that was fitted; pi for all.
    """

    camera: Camera
    max_px: float
    rms_px: float
    outside_px: float
    covered: float
    reach_rad: float


def convert_camera(
    camera: Camera, model: str, *, order: int | None = None, outline: Pixels | None = None
) -> Conversion:
    """Return the camera of `model` that fits `camera` best over its image, in the same frame: poses do not change.

    Raises InputError: `model` is unknown, or cannot represent the lens at all.

    Parameters
    ----------
    order : Brown's number of terms or Scaramuzza's degree, as in `Camera.from_radial_curve`.
    outline : (N, 2) convex hull of the calibration's corners, inside which errors count most; None: whole image.
    """
    pixels = grid_pixels(camera.size_px, CONVERT_GRID).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    pixels, rays = pixels[valid], rays[valid]
    if len(pixels) < MIN_COVERED_SAMPLES:
        raise InputError("camera conversion: the camera has hardly any valid rays in its own image; calibrate it again")
    theta = _off_axis_rad(rays)
    centre = camera.axis_px
    inside = np.ones(len(pixels), dtype=bool) if outline is None else _inside(outline, pixels)
    if not inside.any():
        raise InputError("camera conversion: no corner was seen in the camera's field of view; calibrate it again")
    weight, to = np.where(inside, 1.0, OUTSIDE_WEIGHT), camera_model(model)
    found: Conversion | None = None
    for limit in LIMITS_RAD:
        near = theta <= limit
        if near.sum() < MIN_COVERED_SAMPLES or (found is not None and near.mean() == found.covered):
            continue
        try:
            start = _start(to, camera.size_px, theta[near], pixels[near], centre, order)
        except InputError:
            continue
        fitted = refit_camera(start, rays[near], pixels[near], weight=weight[near])
        trial = _compared(fitted, rays, pixels, near, inside, float(limit))
        if found is None or trial.max_px < found.max_px:
            found = trial
        if found.max_px < FOLLOWS_PX or fitted.max_angle_rad > np.pi / 2 or theta.max() < WIDE_RAD:
            return found
    if found is None:
        raise InputError(f"camera conversion: a {model} camera cannot follow this lens")
    return found


def _compared(
    fitted: Camera, rays: Rays, pixels: Pixels, near: BoolArray, inside: BoolArray, limit_rad: float
) -> Conversion:
    """Return the conversion to `fitted`, with its errors at the rays `near` the axis, inside and outside the
    outline."""
    projected, seen = fitted.project(rays)
    error_px = np.linalg.norm(projected - pixels, axis=-1)
    seen &= near
    known, other = error_px[seen & inside], error_px[seen & ~inside]
    if not known.size:
        known = other
    rms = float(np.sqrt(np.mean(known**2)))
    covered = seen.sum() / near.size
    return Conversion(fitted, float(known.max()), rms, float(other.max(initial=0.0)), covered, limit_rad)


def fit_camera(
    model: type[Camera],
    size_px: tuple[int, int],
    rays: Rays,
    pixels: Pixels,
    centre_px: FloatArray,
    *,
    order: int | None = None,
) -> Camera:
    """Return the camera of `model` that projects `rays` (N, 3) closest to `pixels` (N, 2), by least squares.

    The initial values come from the radial curve around `centre_px`. Rays outside the model's field of view are left
    out. Raises InputError where the model cannot represent the curve.
    """
    return refit_camera(_start(model, size_px, _off_axis_rad(rays), pixels, centre_px, order), rays, pixels)


def refit_camera(start: Camera, rays: Rays, pixels: Pixels, *, weight: FloatArray | None = None) -> Camera:
    """Return `start` with the parameters that project `rays` (N, 3) closest to `pixels` (N, 2).

    Rays outside the field of view of `start`, or at its edge, are left out; `weight` (N,) is that of each error, 1 by
    default.
    """
    weight = np.ones(len(rays)) if weight is None else weight
    theta = _off_axis_rad(rays)
    used = theta < INSIDE * start.max_angle_rad
    used[used] &= start.project(rays[used])[1]
    stop = Stop(steps=MAX_CONVERT_STEPS, gain=CONVERT_SETTLED, cost=ROUNDING_PX**2 * 2 * int(used.sum()))
    free = np.eye(start.parameters.size)
    return nearest_camera(start, rays[used], pixels[used], free, stop, weight[used])[0]


def _off_axis_rad(rays: Rays) -> FloatArray:
    """Return the angles (N,) of rays (N, 3) from the optical axis."""
    return np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])


def _inside(outline: Pixels, pixels: Pixels) -> BoolArray:
    """Return which of `pixels` (..., 2) are inside a convex `outline` (N, 2) of either orientation, (...,)."""
    side = np.roll(outline, -1, axis=0) - outline
    to = pixels[..., None, :] - outline
    turn = side[:, 0] * to[..., 1] - side[:, 1] * to[..., 0]
    return np.asarray((turn >= 0.0).all(axis=-1) | (turn <= 0.0).all(axis=-1))


def _start(
    model: type[Camera],
    size_px: tuple[int, int],
    theta: FloatArray,
    pixels: Pixels,
    centre: FloatArray,
    order: int | None,
) -> Camera:
    """Return the initial camera from the radial curve of means over rings of equal width in the angle."""
    radius = np.linalg.norm(pixels - centre, axis=-1)
    edges = np.linspace(0.0, theta.max() * (1.0 + 1e-9), MIN_COVERED_SAMPLES + 1)
    ring = np.digitize(theta, edges) - 1
    count = np.bincount(ring, minlength=MIN_COVERED_SAMPLES)
    kept = count > 0
    mean = [np.bincount(ring, v, MIN_COVERED_SAMPLES)[kept] / count[kept] for v in (theta, radius)]
    rising = np.append(True, np.diff(np.maximum.accumulate(mean[1])) > 0.0)
    try:
        curve = RadialCurve(centre, mean[0][rising], mean[1][rising])
        return model.from_radial_curve(size_px, curve, order=order)
    except InputError as error:
        raise InputError(f"camera conversion: a {model.model} camera cannot follow this lens ({error})") from error
