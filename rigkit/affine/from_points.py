"""Affinities for point matches of any matcher: from the motion of neighbouring points, refined on the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import MIN_CORRELATION, grey_of
from rigkit.affine.refine_patches import patch_pyramid, refine_patches
from rigkit.core.arrays import Affines, Pixels
from rigkit.core.errors import DegenerateError

ROUGH_SIGMA_A = 0.1
"""Affinities with a larger median sigma_A are only initial values for the alignment."""

POINTS_AROUND = 12
"""Neighbours of a point, some of which are outliers or on another surface."""
MOTION_ROUNDS = 4


def need_alignment(found: Correspondences) -> bool:
    """Return whether the correspondences have neither directions nor affinities better than ROUGH_SIGMA_A."""
    if found.A21 is None:
        return found.directions is None
    return found.sigma_A is not None and float(np.nanmedian(found.sigma_A)) >= ROUGH_SIGMA_A


def with_affinities(
    found: Correspondences, image1: NDArray[np.generic], image2: NDArray[np.generic]
) -> Correspondences:
    """Return the correspondences whose patches align, with refined pixels2 and affinities.

    The alignment starts at the given affinities, else at those of the local motion of neighbouring points. Raises
    DegenerateError if no patches align.
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
    """Return robust affinities (N, 2, 2) of the motion of each point's neighbours; the identity with too few points."""
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
        # Regularised towards the identity, for collinear neighbours.
        doubt = 1e-3 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-9 * np.eye(2)
        A21 = (right + doubt) @ np.linalg.inv(normal + doubt)
        off = np.linalg.norm(d2 - np.einsum("nij,nkj->nki", A21, d1), axis=-1)
        scale = np.median(off, axis=1, keepdims=True) + 0.1
        weight = 1.0 / (1.0 + (off / scale) ** 2) ** 2
    return np.asarray(A21)
