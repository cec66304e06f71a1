"""What the kernel of blobs.c computes, in numpy and OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.circles.blobs import BLOB_AREAS, DEVIATIONS, MAX_ASPECT
from rigkit.detection.saddles.response import FloatImage


def find_blobs(off: FloatImage, variance: FloatImage) -> FloatArray:
    """Return the blobs (N, 7) of an image minus its local mean: centroid, covariance (uu, uv, vv), area and sign."""
    limit = np.float32(DEVIATIONS) * np.sqrt(np.maximum(variance, np.float32(0.0)))
    parts = []
    for sign, mask in ((1.0, off > limit), (-1.0, off < -limit)):
        pixels, covariance, area = moments(mask)
        flat = covariance.reshape(-1, 4)[:, [0, 1, 3]]
        parts.append(np.column_stack([pixels, flat, area, np.full(len(area), sign)]))
    return np.concatenate(parts)


def moments(mask: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
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
