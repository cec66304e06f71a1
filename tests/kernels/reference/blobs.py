"""What the kernel of blobs.c computes, in numpy and OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.circles.blobs import BLOB_AREAS, DEVIATIONS, FILLING, MAX_ASPECT
from rigkit.detection.saddles.response import FloatImage


def find_blobs(off: FloatImage, variance: FloatImage) -> FloatArray:
    """Return the blobs (N, 6) of an image minus its local mean: centroid, covariance (uu, uv, vv) and sign."""
    limit = np.float32(DEVIATIONS) * np.sqrt(np.maximum(variance, np.float32(0.0)))
    parts = []
    for sign, mask in ((1.0, off > limit), (-1.0, off < -limit)):
        pixels, covariance, area = moments(mask)
        root = np.sqrt(np.maximum(np.linalg.det(covariance), 1e-12))
        filling = area / (4.0 * np.pi * root)
        half_trace = 0.5 * np.trace(covariance, axis1=1, axis2=2)
        # Axes with ratio r have half_trace / root = (r + 1 / r) / 2.
        round_enough = half_trace / root < 0.5 * (MAX_ASPECT + 1.0 / MAX_ASPECT)
        good = (filling > FILLING[0]) & (filling < FILLING[1]) & round_enough
        flat = covariance[good].reshape(-1, 4)[:, [0, 1, 3]]
        parts.append(np.column_stack([pixels[good], flat, np.full(int(good.sum()), sign)]))
    return np.concatenate(parts)


def moments(mask: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centroids (N, 2), covariances (N, 2, 2) and areas (N,) of regions of suitable area off the border."""
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    left, top, wide, high = (stats[:, k] for k in range(4))
    height, width = mask.shape
    inside = (left > 0) & (top > 0) & (left + wide < width) & (top + high < height)
    inside &= (area >= BLOB_AREAS[0]) & (area <= BLOB_AREAS[1])
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
