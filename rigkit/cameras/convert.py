"""The nearest camera of another model: for exchange with programs that lack the model, and for comparisons."""

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
"""Pixels of the source at which the two cameras are held against each other."""
MIN_COVERED_SAMPLES = 60
LIMITS_RAD = (np.pi, *np.radians([80.0, 70.0, 60.0, 50.0, 40.0]))
"""Angles from the axis out to which a model is fitted: the widest at which it follows the lens."""
FOLLOWS_PX = 1.0
"""A model follows the lens where its largest error is below this."""
WIDE_RAD = np.radians(60.0)
"""Narrower limits are tried for perspective models of lenses that reach beyond this; others are to hold everywhere."""
MAX_CONVERT_STEPS = 60
CONVERT_SETTLED = 1e-10
"""The fit stops where a step gains less than this share of the cost,"""
OUTSIDE_WEIGHT = 0.02
"""An error outside the outline of what was seen counts by this much: there the lens is but extrapolated."""
ROUNDING_PX = 1e-10
"""or where pixels are met this well."""
INSIDE = 0.995
"""Rays within this share of the start's field of view take part: at its edge the derivatives have no end."""


@dataclass(frozen=True, eq=False, slots=True)
class Conversion:
    """A camera in place of another one.

    Attributes
    ----------
    max_px, rms_px : error of projection over the part of the image that the new camera covers, inside the outline.
    outside_px : largest error of projection over the rest of that part; 0 without an outline.
    covered : that part, as a share of the pixels that the source covers.
    reach_rad : that part, as an angle from the optical axis; pi where nothing was left out.
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
    """Return the camera of `model` nearest to `camera` over its image, in the same frame: poses stay as they are.

    Raises InputError: `model` is unknown, or the model cannot follow the lens at all.

    Parameters
    ----------
    order : Brown's number of terms or Scaramuzza's degree, as in `Camera.from_radial_curve`.
    outline : (N, 2) convex, of the part of the image where the camera is known, which then counts; None: all of it.
    """
    pixels = grid_pixels(camera.size_px, CONVERT_GRID).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    pixels, rays = pixels[valid], rays[valid]
    if len(pixels) < MIN_COVERED_SAMPLES:
        raise InputError("camera conversion: the source sees next to nothing of its own image; calibrate it again")
    theta = _off_axis_rad(rays)
    centre = camera.axis_px
    inside = np.ones(len(pixels), dtype=bool) if outline is None else _inside(outline, pixels)
    if not inside.any():
        raise InputError("camera conversion: nothing was seen where the camera looks; calibrate it again")
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
        trial = _held_against(fitted, rays, pixels, near, inside, float(limit))
        if found is None or trial.max_px < found.max_px:
            found = trial
        if found.max_px < FOLLOWS_PX or fitted.max_angle_rad > np.pi / 2 or theta.max() < WIDE_RAD:
            return found
    if found is None:
        raise InputError(f"camera conversion: a {model} camera cannot follow this lens")
    return found


def _held_against(
    fitted: Camera, rays: Rays, pixels: Pixels, near: BoolArray, inside: BoolArray, limit_rad: float
) -> Conversion:
    """Return the conversion into `fitted`, its errors at the rays `near` the axis, those `inside` the outline apart."""
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
    """Return the camera of `model` that projects `rays` (N, 3) nearest to `pixels` (N, 2), by least squares.

    Started from the radial curve around `centre_px`. Rays that the model cannot see are left out.
    Raises InputError where the model has no start for this lens.
    """
    theta = _off_axis_rad(rays)
    start = _start(model, size_px, theta, pixels, centre_px, order)
    return refit_camera(start, rays, pixels)


def refit_camera(start: Camera, rays: Rays, pixels: Pixels, *, weight: FloatArray | None = None) -> Camera:
    """Return `start` with the parameters that project `rays` (N, 3) nearest to `pixels` (N, 2).

    Rays that the start cannot see, or only at the edge of its field of view, are left out; `weight` (N,) is that of
    each error, None: all count alike.
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
    """Say which of `pixels` (..., 2) lie inside a convex `outline` (N, 2), in whichever sense it turns, (...,)."""
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
    """Return a first camera from the radial curve: means over rings of equal width in the angle."""
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
