"""Blobs that may be circles: connected regions, darker or brighter than their surroundings, of an ellipse's area.

On every level of a pyramid the image is compared with its local mean, so that neither light nor contrast need be known.
Blurred circles of a lattice remain separate, because the local mean is between those of circles and paper.
A region with area N and covariance S is an ellipse if N = 4 pi sqrt(det S), for any slant.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.saddles.response import BASE_PIXELS, FloatImage, GreyImage

WINDOW_PX = 31
"""Side of the square of the local mean, in pixels of a level."""
BLOB_AREAS = (12.0, 500.0)
"""Range of the areas of blobs on a level, in its pixels: the window covers the largest and its surroundings, and the
ranges of adjacent levels overlap by far more than two blobs of a grid differ."""
DEVIATIONS = 0.2
"""Smallest difference from the local mean, in local standard deviations, in a lattice about half of its contrast."""
SMOOTH_PX = 0.8
"""Blur before the comparison, so that single noisy pixels are no blobs."""
FILLING = (0.88, 1.12)
"""Range of the ratio of the area to that of the ellipse with the same moments: an ellipse has 1, within 0.1 for few
pixels; a square 0.95, a triangle 0.83, regions with holes or arms much less."""
MAX_ASPECT = 6.0
"""Largest ratio of the axes: 80 degrees of slant."""
SMALLEST_LEVEL = 48
"""Smallest shorter side of a level, px: smaller ones have no room for three circles and their paper."""
COARSE_PIXELS = BASE_PIXELS / 4.0
"""Largest number of pixels of the finest level of a coarse search: it takes a quarter of the time."""
FIRST_RADIUS_PX = 8.0
"""Smallest radius of circles in the reduced image of the first fits. With 6 px for 8 px, final centres differ by up to
0.54 instead of 0.25 sigmas from those fitted in the image itself throughout (RENDERED, ten grids in 3840x2160)."""
DUPLICATE = 0.5
"""Largest distance of two blobs of similar size that are one, found on two levels, in radii."""


@dataclass(frozen=True, eq=False, slots=True)
class Blobs:
    """Blobs of one image.

    Attributes
    ----------
    pixels : (N, 2) centroids.
    shape : (N, 2, 2) symmetric; maps the unit circle to the ellipse, px.
    sign : (N,) +1 if brighter than the surroundings, -1 if darker.
    """

    pixels: FloatArray
    shape: FloatArray
    sign: FloatArray

    def __len__(self) -> int:
        return len(self.pixels)

    def chosen(self, which: BoolArray | IntArray) -> Blobs:
        return Blobs(self.pixels[which], self.shape[which], self.sign[which])

    def reduced(self, scale: int) -> Blobs:
        """Return the blobs in an image reduced by `scale` (`reduced`)."""
        return Blobs((self.pixels + 0.5) / scale - 0.5, self.shape / scale, self.sign)

    def radius_px(self) -> FloatArray:
        """Return the radii (N,) of circles with the areas of the ellipses."""
        return np.asarray(np.sqrt(np.linalg.det(self.shape)))

    def reduction(self) -> int:
        """Return by which power of two an image of these circles is reduced for their first fits."""
        return int(2 ** max(0.0, np.floor(np.log2(np.median(self.radius_px()) / FIRST_RADIUS_PX))))


def find_blobs(grey: GreyImage, *, coarse: bool = False) -> Blobs:
    """Return the blobs of `grey`, of both signs and all sizes, without duplicates.

    `coarse`: without those found only on finer levels than one of COARSE_PIXELS.
    """
    level, scale = grey.astype(np.float32), 1.0
    while level.size > (COARSE_PIXELS if coarse else BASE_PIXELS):
        level, scale = _halved(level), 2.0 * scale
    found: list[Blobs] = []
    while min(level.shape) >= SMALLEST_LEVEL or not found:
        found.append(_of_level(level, scale))
        level, scale = _halved(level), 2.0 * scale
    joined = Blobs(*(np.concatenate([getattr(part, name) for part in found]) for name in ("pixels", "shape", "sign")))
    return joined.chosen(_once(joined))


def reduced(grey: GreyImage, scale: int) -> GreyImage:
    """Return the image reduced by `scale`, for a first fit: in 8 bits if it has those."""
    if scale == 1:
        return grey
    height, width = (side // scale for side in grey.shape)
    inside = grey[: height * scale, : width * scale]
    small = cv2.resize(inside, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8) if grey.dtype == np.uint8 else np.asarray(small, np.float32)


def scaled_up(pixels: FloatArray, scale: float) -> FloatArray:
    """Return pixels (N, 2) of a reduced image in the image itself, `scale` times as large."""
    return np.asarray(pixels * scale + 0.5 * (scale - 1.0))


def _halved(level: FloatImage) -> FloatImage:
    height, width = (side // 2 * 2 for side in level.shape)
    return np.asarray(cv2.resize(level[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA))


def _of_level(level: FloatImage, scale: float) -> Blobs:
    smooth = cv2.GaussianBlur(level, (0, 0), SMOOTH_PX)
    window = (WINDOW_PX, WINDOW_PX)
    mean = cv2.blur(smooth, window)
    off = smooth - mean
    # Sums of floats may be slightly negative.
    limit = np.float32(DEVIATIONS) * cv2.sqrt(np.maximum(cv2.blur(off * off, window), 0.0))
    parts = []
    for sign, mask in ((1.0, off > limit), (-1.0, off < -limit)):
        pixels, covariance, area = _moments(mask)
        shape = _root(4.0 * covariance)
        root = np.sqrt(np.maximum(np.linalg.det(covariance), 1e-12))
        filling = area / (4.0 * np.pi * root)
        half_trace = 0.5 * np.trace(covariance, axis1=1, axis2=2)
        # Axes with ratio r have half_trace / root = (r + 1 / r) / 2.
        round_enough = half_trace / root < 0.5 * (MAX_ASPECT + 1.0 / MAX_ASPECT)
        good = (filling > FILLING[0]) & (filling < FILLING[1]) & round_enough
        parts.append(Blobs(scaled_up(pixels[good], scale), shape[good] * scale, np.full(int(good.sum()), sign)))
    return Blobs(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("pixels", "shape", "sign")))


def _moments(mask: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centroids (N, 2), covariances (N, 2, 2) and areas (N,) of regions of suitable area off the border."""
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    left, top, wide, high = (stats[:, k] for k in range(4))
    height, width = mask.shape
    inside = (left > 0) & (top > 0) & (left + wide < width) & (top + high < height)
    inside &= (area >= BLOB_AREAS[0]) & (area <= BLOB_AREAS[1])
    # Bounding boxes of thin, long or ragged regions are far larger than these.
    inside &= area > wide * high * (0.25 * np.pi / MAX_ASPECT)
    inside[0] = False
    wanted = np.flatnonzero(inside)
    number = np.full(count, -1)
    number[wanted] = np.arange(len(wanted))
    at = np.flatnonzero(mask)
    which = number[labels.ravel()[at]]
    at, which = at[which >= 0], which[which >= 0]
    v, u = np.divmod(at, width)
    du, dv = u - centroids[wanted, 0][which], v - centroids[wanted, 1][which]
    sums = [np.bincount(which, part, len(wanted)) for part in (du * du, du * dv, dv * dv)]
    uu, uv, vv = (part / np.maximum(area[wanted], 1.0) for part in sums)
    # The variance of a square pixel is 1/12.
    covariance = np.stack([uu + 1.0 / 12.0, uv, uv, vv + 1.0 / 12.0], axis=-1).reshape(-1, 2, 2)
    return np.asarray(centroids[wanted], np.float64), covariance, area[wanted]


def _root(matrix: FloatArray) -> FloatArray:
    """Return the symmetric square roots of symmetric positive definite (N, 2, 2)."""
    # Cayley and Hamilton: root = (A + sqrt(det A) I) / sqrt(trace A + 2 sqrt(det A)).
    det = np.sqrt(np.maximum(np.linalg.det(matrix), 0.0))
    total = np.sqrt(np.maximum(np.trace(matrix, axis1=1, axis2=2) + 2.0 * det, 1e-12))
    return np.asarray((matrix + det[:, None, None] * np.eye(2)) / total[:, None, None])


def _once(blobs: Blobs) -> IntArray:
    """Return the indices of the blobs without duplicates; of two, that of the finer level, the first, is kept."""
    from scipy.spatial import cKDTree

    if len(blobs) < 2:
        return np.arange(len(blobs))
    radius = blobs.radius_px()
    # Similar sizes are within a factor of exp(0.5).
    place = np.column_stack([blobs.pixels, np.zeros(len(blobs))])
    pairs = cKDTree(place).query_pairs(DUPLICATE * float(radius.max()), output_type="ndarray")
    first, second = pairs.min(axis=1), pairs.max(axis=1)
    near = np.linalg.norm(blobs.pixels[first] - blobs.pixels[second], axis=1) < DUPLICATE * radius[first]
    same = near & (np.abs(np.log(radius[first] / radius[second])) < 0.5) & (blobs.sign[first] == blobs.sign[second])
    keep = np.ones(len(blobs), bool)
    keep[second[same]] = False
    return np.flatnonzero(keep)
