"""Initial values of a calibration, from the views alone, for fields of view from 30 to more than 200 degrees.

Each view gives two rows of its pose by radial alignment. With s the distance of a corner from the optical axis, all
views together give the rest linearly. A point with |offset| = rho has depth z = s f(rho) / rho for Scaramuzza's
polynomial f(rho) = a0 + a2 rho^2 + a3 rho^3 + a4 rho^4, so

    s f(rho) / rho - t3 = +-(r31 x + r32 y)

with one a for all views, and one t3 and one sign for each view. The signs minimise the joint residual. The model asked
for is then fitted to the radial curve.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from rigkit.calibration.solving.radial_alignment import TURN_SIGMAS, Alignment, align, distortion_centre
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera, RadialCurve, image_center
from rigkit.core.arrays import TINY, FloatArray, Mat3, Points, median_of
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import nearest_rotation
from rigkit.optim.robust_scale import SIGMA_OF_MEDIAN

EXPONENTS = ((0, 2, 3, 4), (0, 2, 4), (0, 2), (0,))
"""Exponents of the polynomials tried, until the angle increases with the radius."""
POLYNOMIAL_ROUNDS = 2
ENUMERATE = 6
"""Up to this many views all combinations of signs are tried."""
NARROW = 1.45
"""Models that are limited to 90 degrees are fitted to the curve up to this angle, rad."""
FALLBACK_FOV_RAD = (0.7, 1.4, 2.1, 3.1)
"""Fields of view of the equidistant lenses tried where the views do not determine a curve (all boards parallel)."""
RADIUS_SAMPLES = 96
ORTHONORMAL = 1e-12
"""Deviation from a rotation matrix that is rounding."""
MIN_ALIGNMENT_WEIGHT = 0.1
"""Corners of less weight are outliers, and do not count for the largest radius."""
ON_AXIS, NEAR_AXIS = 1e-4, 1e-3
"""Radii in the image, as parts of the largest: smallest divisor; and limit up to which a corner gives no depth, of its
radius in the camera frame, along its radial line, too: that divides its weight."""
NOTHING = 1e-9
"""Smallest divisor, of lengths (px, mm)."""
NOTHING_RAD = 1e-6
"""Smallest divisor, of angles."""
POLYNOMIAL_RIDGE = 1e-12
"""Added to the unit diagonal: keeps the normal matrix invertible where the views do not determine the polynomial."""
FLIPS = 10
"""Maximal number of rounds for the signs; each lowers the residual, and they end when no sign changes."""


def initialise(
    observations: Observations, size_px: tuple[int, int], model: type[Camera], order: int | None
) -> Iterator[State]:
    """Yield initial states for `model`: with the image centre as principal point, then with the centre of distortion
    estimated from the views (better for a lens far off centre, undetermined without distortion). No state where the
    model cannot represent the curve."""
    table = np.ascontiguousarray(observations.table()[:, :2].T)
    board = np.ascontiguousarray(np.swapaxes(np.take(table, observations.corner, axis=1), 0, 1))
    pixels = np.ascontiguousarray(np.swapaxes(observations.pixels, 1, 2))
    middle = image_center(size_px)

    def fitted(centre: FloatArray, theta: FloatArray, radius: FloatArray) -> Camera | None:
        for limit in (np.inf, NARROW):
            inside = theta < limit
            with suppress(InputError):
                curve = RadialCurve(centre, theta[inside], radius[inside])
                return model.from_radial_curve(size_px, curve, order=order)
        return None

    def around(centre: FloatArray) -> Iterator[State]:
        offset = pixels - centre[:, None]
        alignment = align(offset, board, observations.weight)
        rho = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2)
        rho_max = float(rho[alignment.weight > MIN_ALIGNMENT_WEIGHT].max())
        depths = _Depths(alignment, offset, rho / rho_max, board)
        tried = (depths.curve(exponents) for exponents in EXPONENTS)
        curve = next((c for c in tried if c is not None), None)
        radius = np.linspace(0.0, rho_max, RADIUS_SAMPLES)
        fallback = (np.linspace(0.0, 0.5 * fov, RADIUS_SAMPLES) for fov in FALLBACK_FOV_RAD)
        for theta, sign, t3 in map(depths.known, fallback) if curve is None else [curve]:
            camera = fitted(centre, theta, radius)
            if camera is not None:
                rotation, translation = _posed(alignment, sign, t3)
                yield State.start(camera, rotation, translation, observations)

    yield from around(middle)
    epipole = distortion_centre(pixels, board, observations.weight, middle)
    if (np.abs(epipole - middle) < 0.5 * np.array(size_px)).all():
        yield from around(epipole)


def _posed(alignment: Alignment, sign: FloatArray, t3: FloatArray) -> tuple[Mat3, Points]:
    """Complete the poses with the third row."""
    columns = np.concatenate([alignment.rows[..., :2], (alignment.tilt * sign[:, None])[:, None]], axis=1)
    x, y = columns[..., 0], columns[..., 1]
    third = np.stack([x[:, i] * y[:, j] - x[:, j] * y[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=-1)
    rotation = np.concatenate([columns, third[..., None]], axis=-1)
    # The columns are orthonormal, except for views without an alignment.
    odd = ~(np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(1, 2)) < ORTHONORMAL)
    if odd.any():
        rotation[odd] = nearest_rotation(rotation[odd])
    return rotation, np.concatenate([alignment.rows[..., 2], t3[:, None]], axis=-1)


class _Depths:
    """The linear equations s f(rho) / rho - t3 = sign * depth of all corners, with f, t3 and the signs unknown.

    `rho` (V, C) is relative to the largest used; `offset` and `board` are (V, 2, C).
    """

    def __init__(self, alignment: Alignment, offset: FloatArray, rho: FloatArray, board: FloatArray) -> None:
        xy = alignment.camera_xy(board)
        self._safe = np.maximum(rho, ON_AXIS)
        self._rho, self._weight = rho, alignment.weight
        length = np.maximum(np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2), NOTHING)
        self._s = (xy * offset).sum(axis=1) / length
        largest = np.where(alignment.weight > 0.0, self._s, 0.0).max(axis=1, keepdims=True)
        self._used = (alignment.weight > 0.0) & (self._s > NEAR_AXIS * largest) & (rho > NEAR_AXIS)
        # Of each view: s rho^(k - 1) for each exponent k, the depth, and one for t3.
        self._rows = rows = np.ones((len(rho), len(EXPONENTS[0]) + 2, rho.shape[1]))
        np.divide(self._s, self._safe, out=rows[:, 0])
        np.multiply(self._s, self._safe, out=rows[:, 1])
        for k in range(2, len(EXPONENTS[0])):
            np.multiply(rows[:, k - 1], self._safe, out=rows[:, k])
        np.matmul(alignment.tilt[:, None], board, out=rows[:, -2:-1])
        # Moments about the mean: about zero they would lose digits.
        self._middle = rows.mean(axis=-1)
        self._middle[:, -1] = 0.0
        rows -= self._middle[..., None]

    def curve(self, exponents: tuple[int, ...]) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return the angles at RADIUS_SAMPLES radii in [0, 1], the signs of the tilts and t3 (V,); None where the angle
        does not increase."""
        which = [*(EXPONENTS[0].index(k) for k in exponents), -2]
        s, depth = self._s, self._rows[:, -2] + self._middle[:, -2, None]
        # d rho / d z of the lens converts residuals of z into residuals of rho; at first that of a 45 degree lens.
        slope = self._safe**2 / (np.maximum(s, NOTHING) * (1.0 + self._safe**2))
        weight = np.where(self._used, self._weight * slope, 0.0)
        a, sign, t3 = self._joint(which, weight, None)
        for _ in range(POLYNOMIAL_ROUNDS - 1):
            z = (a @ self._rows[:, which[:-1]]) + (self._middle[:, which[:-1]] @ a)[:, None]
            slope = s / np.maximum(s * s + z * z, TINY)
            residual = np.abs(z - t3[:, None] - sign[:, None] * depth) * slope
            scale = TURN_SIGMAS * SIGMA_OF_MEDIAN * median_of(residual[self._used]) + NOTHING
            weight = np.where(self._used, self._weight * slope / (1.0 + (residual / scale) ** 2), 0.0)
            a, sign, t3 = self._joint(which, weight, sign)
        radius = np.linspace(0.0, 1.0, RADIUS_SAMPLES)
        theta = np.arctan2(radius, (radius[:, None] ** np.array(exponents)) @ a)
        if a[0] <= 0.0 or (np.diff(theta) <= 0.0).any():
            return None
        return theta, sign, t3

    def known(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the result of `curve` for a known curve, with all signs positive."""
        angle = np.interp(self._rho, np.linspace(0.0, 1.0, RADIUS_SAMPLES), theta)
        weight = self._weight * np.sin(angle) ** 2
        z = self._s / np.tan(np.maximum(angle, NOTHING_RAD))
        depth = self._rows[:, -2] + self._middle[:, -2, None]
        t3 = (weight * (z - depth)).sum(axis=1) / np.maximum(weight.sum(axis=1), TINY)
        return theta, np.ones(len(t3)), t3

    def _joint(
        self, which: list[int], weight: FloatArray, sign: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the polynomial a, the signs (V,) and t3 (V,) that minimise
        sum weight^2 (a design - t3_v - sign_v depth)^2 with the rows `which` as design and, last, depth.

        `sign` are initial signs, if known.
        """
        moments = (self._rows * (weight * weight)[:, None]) @ np.swapaxes(self._rows, -1, -2)
        total = np.maximum(moments[:, -1, -1], TINY)
        mean = moments[:, which, -1] / total[:, None]
        central = moments[:, which][:, :, which] - total[:, None, None] * mean[:, :, None] * mean[:, None]
        normal = central[:, :-1, :-1].sum(axis=0)
        scale = np.sqrt(np.diag(normal)) + TINY
        normal = normal / scale[:, None] / scale + POLYNOMIAL_RIDGE * np.eye(len(scale))
        cross = central[:, :-1, -1].T / scale[:, None]
        if sign is None:
            explained = np.asarray(np.linalg.solve(np.linalg.cholesky(normal), cross), dtype=np.float64)
            sign = _signs(explained, central[:, -1, -1])
        a = np.linalg.solve(normal, cross @ sign)
        for _ in range(FLIPS):
            flipped = np.where(cross.T @ a < 0.0, -1.0, 1.0)
            if (flipped == sign).all():
                break
            sign = flipped
            a = np.linalg.solve(normal, cross @ sign)
        if a[0] < 0.0:
            a, sign = -a, -sign
        a = a / scale
        mean += self._middle[:, which]
        return a, sign, mean[:, :-1] @ a - sign * mean[:, -1]


def _signs(explained: FloatArray, size2: FloatArray) -> FloatArray:
    """Return signs s that minimise s^T (diag(size2) - E^T E) s, E (4, V) = `explained`: by trying all for few views,
    else from the lowest eigenvector of the form scaled to unit diagonal, which E E^T gives in four dimensions."""
    views = len(size2)
    if views <= ENUMERATE:
        patterns = np.array([(1.0, *p) for p in itertools.product((1.0, -1.0), repeat=views - 1)])
        return np.asarray(patterns[((patterns @ explained.T) ** 2).sum(axis=1).argmax()])
    scaled = explained / np.sqrt(np.maximum(size2, TINY))
    vector = np.linalg.eigh(scaled @ scaled.T)[1][:, -1]
    return np.where(vector @ scaled < 0.0, -1.0, 1.0)
