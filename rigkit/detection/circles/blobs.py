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
from rigkit.kernels import circles as kernel
from rigkit.kernels.front import shrunk

WINDOW_PX = 31
"""Side of the square of the local mean, in pixels of a level."""
BLOB_AREAS = (12, 500)
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
        return np.asarray(np.sqrt(_determinants(self.shape)))

    def reduction(self) -> int:
        """Return by which power of two an image of these circles is reduced for their first fits."""
        return int(2 ** max(0.0, np.floor(np.log2(np.median(self.radius_px()) / FIRST_RADIUS_PX))))


def find_blobs(grey: GreyImage, *, coarse: bool = False, known: Blobs | None = None) -> Blobs:
    """Return the blobs of `grey`, of both signs and all sizes, without duplicates.

    `coarse`: without those found only on finer levels than one of COARSE_PIXELS. `known`: the result of a coarse
    search, if there was one.
    """
    scale, (height, width) = 1, grey.shape
    while (height // scale) * (width // scale) > (COARSE_PIXELS if coarse else BASE_PIXELS):
        scale *= 2
    level = grey.astype(np.float32) if scale == 1 else shrunk(grey, scale)
    found: list[Blobs] = []
    while (min(level.shape) >= SMALLEST_LEVEL or not found) and (known is None or level.size > COARSE_PIXELS):
        found.append(_of_level(level, float(scale)))
        level, scale = _halved(level), 2 * scale
    found += [] if known is None else [known]
    joined = Blobs(*(np.concatenate([getattr(part, name) for part in found]) for name in ("pixels", "shape", "sign")))
    return joined.chosen(_once(joined))


def reduced(grey: GreyImage, scale: int) -> GreyImage:
    """Return the image reduced by `scale`."""
    return grey if scale == 1 else shrunk(grey, scale)


def scaled_up(pixels: FloatArray, scale: float) -> FloatArray:
    """Return pixels (N, 2) of a reduced image in the image itself, `scale` times as large."""
    return np.asarray(pixels * scale + 0.5 * (scale - 1.0))


def _halved(level: FloatImage) -> FloatImage:
    height, width = (side // 2 * 2 for side in level.shape)
    return np.asarray(cv2.resize(level[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA))


def blob_rules() -> kernel.BlobRules:
    """Return the constants of this module, as the kernel takes them."""
    return kernel.BlobRules.of(
        deviations=DEVIATIONS,
        min_filling=FILLING[0],
        max_filling=FILLING[1],
        max_aspect=MAX_ASPECT,
        min_area=BLOB_AREAS[0],
        max_area=BLOB_AREAS[1],
    )


def _of_level(level: FloatImage, scale: float) -> Blobs:
    smooth = cv2.GaussianBlur(level, (0, 0), SMOOTH_PX)
    window = (WINDOW_PX, WINDOW_PX)
    off = smooth - cv2.blur(smooth, window)
    rows = kernel.find_blobs(off, np.asarray(cv2.blur(off * off, window), np.float32), blob_rules())
    shape = _root(4.0 * rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2))
    return Blobs(scaled_up(rows[:, :2], scale), shape * scale, rows[:, 5])


def _root(matrix: FloatArray) -> FloatArray:
    """Return the symmetric square roots of symmetric positive definite (N, 2, 2)."""
    # Cayley and Hamilton: root = (A + sqrt(det A) I) / sqrt(trace A + 2 sqrt(det A)).
    det = np.sqrt(np.maximum(_determinants(matrix), 0.0))
    total = np.sqrt(np.maximum(matrix[:, 0, 0] + matrix[:, 1, 1] + 2.0 * det, 1e-12))
    return np.asarray((matrix + det[:, None, None] * np.eye(2)) / total[:, None, None])


def _determinants(matrix: FloatArray) -> FloatArray:
    """Return the determinants (N,) of (N, 2, 2): numpy takes ten times as long."""
    return np.asarray(matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0])


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
