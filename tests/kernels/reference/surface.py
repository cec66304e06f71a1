"""What the kernels of surface.c compute, in numpy."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.tags.codes import transferred
from rigkit.kernels.surface import SURFACE_DEGREE, TERMS_OF_DEGREE

POWERS = np.array([(degree - k, k) for degree in range(SURFACE_DEGREE + 1) for k in range(degree + 1)])


def perspective(places: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return the homography (3, 3) of depth 1 at the mean of `places` (N, 2)."""
    normalise = []
    for points in (places, pixels):
        middle, size = points.mean(axis=0), float(points.std())
        normalise.append(
            np.array([[1.0 / size, 0.0, -middle[0] / size], [0.0, 1.0 / size, -middle[1] / size], [0, 0, 1]])
        )
    (x, y), (u, v) = (
        (points * matrix[0, 0] + matrix[:2, 2]).T for points, matrix in zip((places, pixels), normalise, strict=True)
    )
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1),
        ]
    )
    own = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    matrix = np.linalg.inv(normalise[1]) @ own @ normalise[0]
    return np.asarray(matrix / (matrix[2] @ [*places.mean(axis=0), 1.0]))


class Polynomials:
    """Of every degree through `values` (N, 2) at `places` (N, 2), in units of `size` from `middle`."""

    def __init__(self, places: FloatArray, values: FloatArray, middle: FloatArray, size: float, degree: int) -> None:
        self.middle, self.size = middle, size
        self.basis, self.triangle = np.linalg.qr(_terms((places - middle) / size, POWERS[: TERMS_OF_DEGREE[degree]]))
        self.basis_values = self.basis.T @ values
        self.leverage = np.cumsum(self.basis**2, axis=1)
        self.predicted = [
            (values - self.basis[:, :k] @ self.basis_values[:k]) / (1.0 - self.leverage[:, k - 1, None])
            for k in TERMS_OF_DEGREE[: degree + 1]
        ]
        self.misses = np.array([np.median(np.hypot(*left.T)) for left in self.predicted])

    def at(self, wanted: FloatArray, degree: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return values and first and second derivatives along x and y at `wanted` (M, 2)."""
        here, end = (wanted - self.middle) / self.size, TERMS_OF_DEGREE[degree]
        factors = np.linalg.solve(self.triangle[:end, :end], self.basis_values[:end])
        out = [
            _terms(here, POWERS[:end], along) @ factors / self.size ** sum(along)
            for along in ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2))
        ]
        return out[0], np.stack(out[1:3], axis=1), np.stack(out[3:], axis=1)

    def most_certain(self, wanted: FloatArray, degrees: int) -> tuple[FloatArray, FloatArray]:
        """Return values (M, 2) and gains (M,) by that of the first `degrees` that misses times the gain least."""
        rows = _terms((wanted - self.middle) / self.size, POWERS[: len(self.basis_values)])
        parts, ends = np.linalg.solve(self.triangle.T, rows.T), np.array(TERMS_OF_DEGREE[:degrees]) - 1
        gains = np.sqrt(np.cumsum(parts**2, axis=0)[ends])
        values = np.cumsum(parts[:, :, None] * self.basis_values[:, None], axis=0)[ends]
        most_certain = (self.misses[:degrees, None] * np.maximum(gains, 1.0)).argmin(axis=0)
        each = np.arange(len(wanted))
        return values[most_certain, each], gains[most_certain, each]


def _terms(places: FloatArray, powers: IntArray, along: tuple[int, int] = (0, 0)) -> FloatArray:
    out = np.ones((len(places), len(powers)))
    for axis, times in enumerate(along):
        power, factor = powers[:, axis], np.ones(len(powers))
        for k in range(times):
            factor *= power - k
        out *= factor * places[:, axis, None] ** np.maximum(power - times, 0)
    return out


def read_modules(image: GreyImage, quads: FloatArray, side: int) -> tuple[FloatArray, FloatArray]:
    """Return the modules' brightness of mean 0 and length 1 (N, side * side), and its standard deviation (N,)."""
    middle = (np.arange(side) + 0.5) / side
    places = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    bright = sample(image, transferred(maps_of_quads(quads), places)).astype(np.float64)
    bright -= bright.mean(axis=1, keepdims=True)
    length = np.linalg.norm(bright, axis=1, keepdims=True)
    return bright / np.maximum(length, 1e-9), length[:, 0] / side


def read_codes(
    image: GreyImage, quads: FloatArray, side: int, patterns: FloatArray, least: float
) -> tuple[IntArray, FloatArray]:
    bright, spread = read_modules(image, quads, side)
    likeness = np.where(spread[:, None] >= least, bright @ patterns.T, 0.0)
    return likeness.argmax(axis=1), likeness[np.arange(len(quads)), likeness.argmax(axis=1)]


def maps_of_quads(quads: FloatArray) -> FloatArray:
    """Return the homographies (N, 3, 3) of the unit square, corners (0,0) (1,0) (1,1) (0,1), to the quads (N, 4, 2).

    Heckbert, Fundamentals of Texture Mapping and Image Warping, 1989, section 2.2.3.
    """
    p0, p1, p2, p3 = quads.transpose(1, 0, 2)
    total, d1, d2 = p0 - p1 + p2 - p3, p1 - p2, p3 - p2
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    area = np.where(np.abs(area) < 1e-12, 1e-12, area)
    g = (total[:, 0] * d2[:, 1] - total[:, 1] * d2[:, 0]) / area
    h = (d1[:, 0] * total[:, 1] - d1[:, 1] * total[:, 0]) / area
    out = np.ones((len(quads), 3, 3))
    out[:, :2, 0], out[:, :2, 1], out[:, :2, 2] = p1 - p0 + g[:, None] * p1, p3 - p0 + h[:, None] * p3, p0
    out[:, 2, 0], out[:, 2, 1] = g, h
    return out
