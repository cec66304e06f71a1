"""Where a calibration starts, without any guess, from 30 degrees to beyond 200.

Each view gives two rows of its pose by radial alignment. With s the distance of a corner from the optical axis, all
views together give the rest linearly: a point with |offset| = rho has depth z = s f(rho) / rho for the polynomial
f(rho) = a0 + a2 rho^2 + a3 rho^3 + a4 rho^4 of Scaramuzza, so

    s f(rho) / rho - t3 = +-(r31 x + r32 y)

with one a for all views, one t3 and one sign a view. The signs are the vector that makes the joint residual smallest.
The radial curve found so is handed to the model asked for, which fits itself to it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from rigkit.arrays import FloatArray
from rigkit.calibration.observations import Observations
from rigkit.calibration.radial_alignment import Alignment, align, distortion_centre
from rigkit.calibration.solver import State, evaluate
from rigkit.cameras.base import Camera, image_center
from rigkit.errors import InputError
from rigkit.geometry.rotation import nearest_rotation

__all__ = ["initialise", "start_error"]

EXPONENTS = ((0, 2, 3, 4), (0, 2, 4), (0, 2), (0,))
"""Polynomials tried from rich to poor, until the angle increases with the radius."""
ROUNDS = 3
ENUMERATE = 6
"""Up to this many views all patterns of signs are tried."""
NARROW = 1.45
"""Models that end at 90 degrees are fitted to the curve up to here, rad."""
FALLBACK_FOV_RAD = (0.7, 1.4, 2.1, 3.1)
"""Fields of view of the equidistant lenses tried where the views do not determine a curve (all boards parallel)."""
SAMPLES = 96


def initialise(
    observations: Observations, size_px: tuple[int, int], model: type[Camera], order: int | None
) -> Iterator[State]:
    """Yield start states for `model`: around the middle of the image, then around the centre of distortion that the
    views give (better for a lens far off the middle, useless for one without distortion). None where no camera of the
    model comes near."""
    weight = observations.weight
    board = observations.table()[observations.corner][..., :2]
    middle = image_center(size_px)
    yield from _starts(observations, board, middle, size_px, model, order)
    epipole = distortion_centre(observations.pixels, board, weight, middle)
    if (np.abs(epipole - middle) < 0.5 * np.array(size_px)).all():
        yield from _starts(observations, board, epipole, size_px, model, order)


def start_error(state: State, observations: Observations) -> float:
    """Return the median distance in px between measured and projected corners."""
    norm = evaluate(state, observations).norm(observations)
    return float(np.median(norm[observations.present]))


def _starts(
    observations: Observations,
    board: FloatArray,
    centre: FloatArray,
    size_px: tuple[int, int],
    model: type[Camera],
    order: int | None,
) -> Iterator[State]:
    offset = observations.pixels - centre
    alignment = align(offset, board, observations.weight)
    rho = np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2)
    rho_max = float(rho[alignment.weight > 0.1].max())
    tried = (_curve(alignment, rho / rho_max, board, offset, exponents) for exponents in EXPONENTS)
    curve = next((c for c in tried if c is not None), None)
    level = np.ones(len(rho))
    fallback = [(fov * np.linspace(0.0, 0.5, SAMPLES), level) for fov in FALLBACK_FOV_RAD]
    for theta, depth_sign in fallback if curve is None else [curve]:
        radius = np.linspace(0.0, rho_max, SAMPLES)
        camera = _fitted(model, size_px, centre, theta, radius, order)
        if camera is not None:
            yield _posed(camera, alignment, theta, radius, depth_sign, rho, board, observations)


def _fitted(
    model: type[Camera],
    size_px: tuple[int, int],
    centre: FloatArray,
    theta: FloatArray,
    radius: FloatArray,
    order: int | None,
) -> Camera | None:
    for limit in (np.inf, NARROW):
        inside = theta < limit
        try:
            return model.from_radial_curve(size_px, centre, theta[inside], radius[inside], order=order)
        except InputError:
            continue
    return None


def _posed(
    camera: Camera,
    alignment: Alignment,
    theta: FloatArray,
    radius: FloatArray,
    depth_sign: FloatArray,
    rho: FloatArray,
    board: FloatArray,
    observations: Observations,
) -> State:
    """Complete the poses with the third row: t3 is the weighted mean of z - r3 x over the corners."""
    x, y = np.moveaxis(alignment.camera_xy(board), -1, 0)
    s = np.sqrt(x * x + y * y)
    angle = np.interp(rho, radius, theta)
    z = s / np.tan(np.maximum(angle, 1e-6))
    tilt = alignment.tilt * depth_sign[:, None]
    weight = alignment.weight * np.sin(angle) ** 2
    t3 = (weight * (z - _depth(tilt, board))).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-12)
    columns = np.concatenate([alignment.rows[..., :2], tilt[:, None, :]], axis=1)
    third = np.cross(columns[..., 0], columns[..., 1])
    rotation = nearest_rotation(np.concatenate([columns, third[..., None]], axis=-1))
    translation = np.concatenate([alignment.rows[..., 2], t3[:, None]], axis=-1)
    return State.start(camera, rotation, translation, observations)


def _curve(
    alignment: Alignment, rho: FloatArray, board: FloatArray, offset: FloatArray, exponents: tuple[int, ...]
) -> tuple[FloatArray, FloatArray] | None:
    """Return the angles at SAMPLES radii in [0, 1] and the signs of the tilts, None where the angle does not increase.

    `rho` (V, C) is relative to the largest used.
    """
    length = np.maximum(np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2), 1e-9)
    x, y = np.moveaxis(alignment.camera_xy(board), -1, 0)
    s = (x * offset[..., 0] + y * offset[..., 1]) / length
    safe = np.maximum(rho, 1e-4)
    # One contiguous array for each coefficient: s rho^(k - 1).
    powers = {0: s / safe, 2: s * safe}
    powers[3] = powers[2] * safe
    powers[4] = powers[3] * safe
    design = np.stack([powers[k] for k in exponents])
    depth = _depth(alignment.tilt, board)
    used = (alignment.weight > 0.0) & (s > 0.0) & (rho > 1e-3)
    # d rho / d z of the lens turns residuals of z into residuals of rho; at first for a lens of 45 degrees.
    slope = safe**2 / (np.maximum(s, 1e-9) * (1.0 + safe**2))
    weight = np.where(used, alignment.weight * slope, 0.0)
    a, sign = _joint(design, depth, weight, None)
    for _ in range(ROUNDS - 1):
        z = np.tensordot(a, design, 1)
        residual = z - sign[:, None] * depth
        squared = weight**2
        residual -= ((squared * residual).sum(axis=1) / np.maximum(squared.sum(axis=1), 1e-300))[:, None]
        slope = s / np.maximum(s**2 + z**2, 1e-300)
        residual = np.abs(residual) * slope
        scale = 2.5 * 1.4826 * float(np.median(residual[used])) + 1e-9
        weight = np.where(used, alignment.weight * slope / (1.0 + (residual / scale) ** 2), 0.0)
        a, sign = _joint(design, depth, weight, sign)
    radius = np.linspace(0.0, 1.0, SAMPLES)
    theta = np.arctan2(radius, (radius[:, None] ** np.array(exponents)) @ a)
    if a[0] <= 0.0 or (np.diff(theta) <= 0.0).any():
        return None
    return theta, sign


def _depth(tilt: FloatArray, board: FloatArray) -> FloatArray:
    """Return r31 x + r32 y of the corners, (V, C)."""
    return np.asarray(tilt[:, :1] * board[..., 0] + tilt[:, 1:] * board[..., 1])


def _joint(
    design: FloatArray, depth: FloatArray, weight: FloatArray, sign: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return the polynomial a and the signs (V,) that minimise sum weight^2 (a design - t3_v - sign_v depth)^2.

    `design` is (coefficients, V, C). `sign` is where the search for the signs starts; None: from scratch.
    """
    squared = weight**2
    total = np.maximum(squared.sum(axis=1), 1e-300)
    centred = (design - ((squared * design).sum(axis=2) / total)[..., None]) * weight
    right = (depth - ((squared * depth).sum(axis=1) / total)[:, None]) * weight
    flat = centred.reshape(len(design), -1)
    normal = flat @ flat.T
    scale = np.sqrt(np.diag(normal)) + 1e-300
    normal = normal / scale[:, None] / scale + 1e-12 * np.eye(len(scale))
    cross = (centred * right).sum(axis=2) / scale[:, None]
    if sign is None:
        sign = _signs(np.linalg.solve(np.linalg.cholesky(normal), cross), (right**2).sum(axis=1))
    a = np.linalg.solve(normal, cross @ sign)
    for _ in range(10):
        flipped = np.where(cross.T @ a < 0.0, -1.0, 1.0)
        if (flipped == sign).all():
            break
        sign = flipped
        a = np.linalg.solve(normal, cross @ sign)
    if a[0] < 0.0:
        a, sign = -a, -sign
    return a / scale, sign


def _signs(explained: FloatArray, size2: FloatArray) -> FloatArray:
    """Return the signs s that make s^T (diag(size2) - E^T E) s small, E (4, V) = `explained`: all patterns for few
    views; for many the lowest eigenvector of the form scaled to unit diagonal, which E E^T gives in four dimensions."""
    views = len(size2)
    if views <= ENUMERATE:
        patterns = np.array([(1.0, *p) for p in itertools.product((1.0, -1.0), repeat=views - 1)])
        return np.asarray(patterns[((patterns @ explained.T) ** 2).sum(axis=1).argmax()])
    scaled = explained / np.sqrt(np.maximum(size2, 1e-300))
    vector = np.linalg.eigh(scaled @ scaled.T)[1][:, -1]
    return np.where(vector @ scaled < 0.0, -1.0, 1.0)
