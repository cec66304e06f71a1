"""Affinities of bare points that any matcher found: from how their neighbours move, then from the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import grey_of
from rigkit.affine.refine_patches import patch_pyramid, refine_patches
from rigkit.core.arrays import Affines, Pixels
from rigkit.core.errors import DegenerateError

ROUGH_SIGMA_A = 0.1
"""Affinities that are known no better than that are only where an alignment starts."""

POINTS_AROUND = 12
"""Points around, of which some lie on another surface or are wrong."""
MOTION_ROUNDS = 4
MIN_CORRELATION = 0.9


def are_rough(found: Correspondences) -> bool:
    """Say whether the correspondences are bare points, or have affinities of no use as they are."""
    if found.A21 is None:
        return found.directions is None
    return found.sigma_A is not None and float(np.nanmedian(found.sigma_A)) >= ROUGH_SIGMA_A


def with_affinities(
    found: Correspondences, image1: NDArray[np.generic], image2: NDArray[np.generic]
) -> Correspondences:
    """Return the correspondences whose patches align, with the places and affinities that align them.

    Affinities that are there are where the alignment starts, where none are the local motion of the neighbours is.
    Raises DegenerateError where none align.
    """
    start = _local_motion(found.pixels1, found.pixels2)
    if found.A21 is not None:
        start = np.where(np.isfinite(found.A21), found.A21, start)
    first, second = patch_pyramid(grey_of(image1, "image 1")), patch_pyramid(grey_of(image2, "image 2"))
    refined = refine_patches(first, second, found.pixels1, found.pixels2, start)
    with np.errstate(invalid="ignore"):
        good = refined.valid & (refined.correlation >= MIN_CORRELATION)
    if not good.any():
        raise DegenerateError(f"none of {len(found)} matches could be aligned; check that they are of these two images")
    return replace(
        found.select(good),
        pixels2=refined.pixels2[good],
        A21=refined.A21[good],
        sigma_px=refined.sigma_px[good],
        sigma_A=refined.sigma_A[good],
    )


def _local_motion(pixels1: Pixels, pixels2: Pixels) -> Affines:
    """Return the affinities (N, 2, 2) that the neighbours of each point show, robustly; one where they do not."""
    from scipy.spatial import cKDTree

    count = min(POINTS_AROUND + 1, len(pixels1))
    if count < 4:
        return np.broadcast_to(np.eye(2), (len(pixels1), 2, 2)).copy()
    _, near = cKDTree(pixels1).query(pixels1, k=count)
    d1, d2 = (pixels[near[:, 1:]] - pixels[:, None] for pixels in (pixels1, pixels2))
    weight = np.ones(d1.shape[:2])
    A21 = np.broadcast_to(np.eye(2), (len(pixels1), 2, 2)).copy()
    for _ in range(MOTION_ROUNDS):
        normal = np.einsum("nk,nki,nkj->nij", weight, d1, d1)
        right = np.einsum("nk,nki,nkj->nij", weight, d2, d1)
        # Neighbours on one line say nothing across it: a little of "as it is" decides there.
        doubt = 1e-3 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-9 * np.eye(2)
        A21 = (right + doubt) @ np.linalg.inv(normal + doubt)
        off = np.linalg.norm(d2 - np.einsum("nij,nkj->nki", A21, d1), axis=-1)
        scale = np.median(off, axis=1, keepdims=True) + 0.1
        weight = 1.0 / (1.0 + (off / scale) ** 2) ** 2
    return np.asarray(A21)
