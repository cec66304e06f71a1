"""Affine correspondences of two images of a textured scene: SIFT in simulated views, refined by patch alignment.

With simulated tilts of each image (ASIFT, Morel and Yu 2009) features of surfaces match that the two cameras see at
different slants. Scale, orientation and tilt of two features give an initial affinity, which patch alignment refines.
Point matches of any other matcher get one from the motion of their neighbours (`with_affinities`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.refine_patches import patch_pyramid, refine_patches
from rigkit.core.arrays import Affines, BoolArray, FloatArray, IntArray, Pixels, in_8_bits
from rigkit.core.errors import DegenerateError, InputError
from rigkit.kernels.patches import Pyramid

TILTS = (1.0, np.sqrt(2.0), 2.0)
"""Simulated tilts: combined over both images they cover slants of 60 degrees and more."""
ROLL_STEP_DEG = 72.0
"""Step of the tilts' direction, over the tilt (as in ASIFT)."""
SAME_POINT_PX = 8.0
"""Features closer than this are one point in different simulated views, and no rivals in the ratio test."""
RIVALS = 8
"""Nearest descriptors among which a rival is sought."""
MIN_CORRELATION = 0.9
"""Smallest correlation of two aligned patches."""
MAX_RATIO = 0.85
"""Largest descriptor distance over that of the best rival elsewhere in the image (D. Lowe, IJCV 2004)."""
CELL_PX = 4.0
"""Side of the cells with at most one match each."""
FEATURES_OF_VIEWS = (600, 6000)
"""Features of a tilted view, and the most of a plain one."""
AREA_OF_FEATURE = 150.0
"""Pixels of a plain view per feature."""
MAX_TILTED_AREA = 1e6
"""Pixels of a tilted view at the most: larger images are shrunk first."""
ENOUGH_PLAIN = 300
"""Correspondences of plain views below which tilted views are used too."""
MIN_SIZE_PX = 64
ROUGH_SIGMA_A = 0.1
"""Affinities with a larger median sigma_A are only initial values for the alignment."""

POINTS_AROUND = 12
"""Neighbours of a point, some of which are outliers or on another surface."""
MOTION_ROUNDS = 4


class _Features(NamedTuple):
    pixels: Pixels
    frames: FloatArray
    descriptors: NDArray[np.float32]


def match_affine_features(
    image1: NDArray[Any],
    image2: NDArray[Any],
    *,
    tilts: Sequence[float] | None = None,
    features_per_view: int | None = None,
    unique: bool = False,
) -> Correspondences:
    """Return affine correspondences of two images, with some outliers.

    Raises InputError: not images, or too small; DegenerateError: no correspondences (no texture, or images of
    different scenes).

    Parameters
    ----------
    image1, image2 : (H, W) or (H, W, 3) RGB, uint8 or uint16.
    tilts : simulated tilts, 1 (none) and above. None: 1, and those of TILTS if that gives too few correspondences.
    features_per_view : strongest SIFT features kept in each simulated view; None: by the area of the image.
    unique : similar features of the same image are rivals too. Repeated structures (tiles, keys, bricks) are easily
        matched with a shift of one period, and such matches may fit the epipolar geometry.
    """
    greys = grey_of(image1, "image1"), grey_of(image2, "image2")
    pyramid1, pyramid2 = (patch_pyramid(grey) for grey in greys)
    for views in (_views(tilts),) if tilts is not None else (_views((1.0,)), _views(TILTS)):
        first, second = (_features(grey, views, features_per_view) for grey in greys)
        pairs, tried = _aligned(first, second, _match(first, second, unique), pyramid1, pyramid2)
        if len(pairs) >= ENOUGH_PLAIN:
            break
    if not len(pairs):
        what = f"none of {tried} matches could be aligned" if tried else "no feature matches in both images"
        raise DegenerateError(
            f"affine features: {what}; check that they show one textured scene, from places not too far apart"
        )
    return pairs


def _aligned(
    first: _Features,
    second: _Features,
    matched: tuple[IntArray, IntArray, FloatArray],
    pyramid1: Pyramid,
    pyramid2: Pyramid,
) -> tuple[Correspondences, int]:
    """Return the matches of two images' features whose patches align, and the number of matches tried."""
    i, j, rank = matched
    once = _one_per_cell(first.pixels[i], second.pixels[j], rank)
    i, j = i[once], j[once]
    A21 = second.frames[j] @ np.linalg.inv(first.frames[i]) if i.size else np.zeros((0, 2, 2))
    refined = refine_patches(pyramid1, pyramid2, first.pixels[i], second.pixels[j], A21)
    with np.errstate(invalid="ignore"):
        good = refined.valid & (refined.correlation >= MIN_CORRELATION)
    good[good] = _one_per_cell(first.pixels[i][good], refined.pixels2[good], refined.sigma_A[good])
    pairs = Correspondences(
        first.pixels[i][good],
        refined.pixels2[good],
        refined.A21[good],
        None,
        refined.sigma_px[good],
        refined.sigma_A[good],
    )
    return pairs, i.size


def _views(tilts: Sequence[float]) -> list[tuple[float, float]]:
    """Return (tilt, roll in rad) of the simulated views."""
    views = []
    for tilt in tilts:
        if tilt < 1.0:
            raise InputError(f"affine features: tilts are 1 and above, got {tilt}")
        rolls = np.arange(0.0, 180.0, ROLL_STEP_DEG / tilt) if tilt > 1.0 else [0.0]
        views += [(float(tilt), float(np.radians(roll))) for roll in rolls]
    return views


def grey_of(image: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """Return the image in grey, 8 bits; raises InputError if it is not an image, or too small."""
    import cv2

    array = np.asarray(image)
    if (
        array.ndim not in (2, 3)
        or array.dtype not in (np.uint8, np.uint16)
        or (array.ndim == 3 and array.shape[2] != 3)
    ):
        raise InputError(
            f"affine features, {name}: expected HxW or HxWx3 of uint8 or uint16, got {array.shape} {array.dtype}"
        )
    if min(array.shape[:2]) < MIN_SIZE_PX:
        raise InputError(f"affine features, {name}: at least {MIN_SIZE_PX} px a side, got {array.shape[:2]}")
    array = in_8_bits(array)
    if array.ndim == 3:
        array = cv2.cvtColor(np.ascontiguousarray(array), cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(array)


def _features(grey: NDArray[np.uint8], views: Sequence[tuple[float, float]], count: int | None) -> _Features:
    """Return the features of all simulated views, in pixels of the image."""
    import cv2

    parts = []
    for tilt, roll in views:
        image, scale = (grey, 1.0) if tilt == 1.0 else _downscaled(grey)
        area = image.shape[0] * image.shape[1]
        most = int(np.clip(area / AREA_OF_FEATURE, *FEATURES_OF_VIEWS)) if tilt == 1.0 else FEATURES_OF_VIEWS[0]
        view, mask, view_from_image = _tilted_view(image, tilt, roll)
        keypoints, descriptors = cv2.SIFT.create(nfeatures=count or most).detectAndCompute(view, mask)
        if not keypoints:
            continue
        inverse = np.linalg.inv(view_from_image[:, :2])
        pixels = (np.array([k.pt for k in keypoints]) - view_from_image[:, 2]) @ inverse.T
        angle = np.radians([k.angle for k in keypoints])
        c, s = np.cos(angle), np.sin(angle)
        turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
        size = np.array([k.size for k in keypoints])[:, None, None]
        # RootSIFT: Euclidean distances of square roots compare histograms better.
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6))
        # Pixel centres of a shrunk image are at half-integer positions of the scale.
        pixels = scale * (pixels + 0.5) - 0.5
        parts.append(_Features(pixels, scale * inverse @ (size * turn), root.astype(np.float32)))
    if not parts:
        return _Features(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 128), dtype=np.float32))
    return _Features(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _downscaled(grey: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """Return the image shrunk to at most MAX_TILTED_AREA, and the size of its pixels in those of the original."""
    import cv2

    scale = np.sqrt(grey.shape[0] * grey.shape[1] / MAX_TILTED_AREA)
    if scale <= 1.0:
        return grey, 1.0
    size = round(grey.shape[1] / scale), round(grey.shape[0] / scale)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8), grey.shape[1] / size[0]


def _tilted_view(
    grey: NDArray[np.uint8], tilt: float, roll: float
) -> tuple[NDArray[Any], NDArray[Any] | None, FloatArray]:
    """Return the image turned by `roll` and squeezed by `tilt` along x, its mask, and view_from_image (2, 3)."""
    import cv2

    if tilt == 1.0:
        return grey, None, np.eye(2, 3)
    height, width = grey.shape
    c, s = np.cos(roll), np.sin(roll)
    turn = np.array([[c, -s], [s, c]])
    corners = np.array([[0.0, 0.0], [width - 1.0, 0.0], [0.0, height - 1.0], [width - 1.0, height - 1.0]]) @ turn.T
    low, size = corners.min(axis=0), np.ceil(np.ptp(corners, axis=0)).astype(int) + 1
    # The border is replicated: an edge between image and background would give many features.
    outside = cv2.BORDER_REPLICATE
    turned = cv2.warpAffine(grey, np.column_stack([turn, -low]), size.tolist(), borderMode=outside)
    blurred = cv2.GaussianBlur(turned, (0, 0), sigmaX=0.8 * np.sqrt(tilt**2 - 1.0), sigmaY=0.01)
    squeeze = np.diag([1.0 / tilt, 1.0])
    out = (int(np.ceil(size[0] / tilt)), int(size[1]))
    view = cv2.warpAffine(blurred, np.column_stack([squeeze, np.zeros(2)]), out, borderMode=outside)
    view_from_image = np.column_stack([squeeze @ turn, -squeeze @ low])
    mask = cv2.warpAffine(np.full_like(grey, 255), view_from_image, out, flags=cv2.INTER_NEAREST)
    return view, cv2.erode(mask, np.ones((9, 9), np.uint8), borderValue=0), view_from_image


def _match(first: _Features, second: _Features, unique: bool) -> tuple[IntArray, IntArray, FloatArray]:
    """Return indices (M,) and (M,) of mutual nearest neighbours that pass the ratio test, and their distances (M,)."""
    forward, distance, rival = _nearest(first, second)
    backward, _, _ = _nearest(second, first, rivals=1)
    if not forward.size or not backward.size:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
    returned = first.pixels[backward[forward]]
    mutual = np.linalg.norm(returned - first.pixels, axis=1) < SAME_POINT_PX
    if unique:
        for features, which in ((first, slice(None)), (second, forward)):
            # The nearest feature is the feature itself.
            own = _nearest(features, features)[2]
            rival = np.minimum(rival, own[which]) if own.size else rival
    i = np.flatnonzero(mutual & (distance < MAX_RATIO * rival))
    return i, forward[i], distance[i]


def _nearest(
    first: _Features, second: _Features, *, rivals: int = RIVALS, block: int = 1024
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the nearest feature of `second` for each of `first`, its distance, and that of the nearest other point
    among the `rivals` nearest features."""
    n, m = len(first.pixels), len(second.pixels)
    if m <= RIVALS or n == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0)
    nearest, rival = np.empty(n), np.empty(n)
    best = np.empty(n, dtype=np.int64)
    for start in range(0, n, block):
        rows = slice(start, min(start + block, n))
        similarity = first.descriptors[rows] @ second.descriptors.T
        each = np.arange(len(similarity))
        top, values = np.empty((len(each), rivals), np.int64), np.empty((len(each), rivals), np.float32)
        # Repeated argmax: np.partition takes twenty times as long.
        for k in range(rivals):
            top[:, k] = similarity.argmax(axis=1)
            values[:, k] = similarity[each, top[:, k]]
            similarity[each, top[:, k]] = -np.inf
        distance = np.sqrt(np.maximum(2.0 - 2.0 * values, 0.0))
        distinct = np.linalg.norm(second.pixels[top] - second.pixels[top[:, :1]], axis=-1) > SAME_POINT_PX
        other = np.where(distinct, distance, np.inf).min(axis=1)
        # Without a rival among the nearest ones the furthest of them is a lower bound.
        rival[rows] = np.where(np.isfinite(other), other, distance[:, -1])
        best[rows], nearest[rows] = top[:, 0], distance[:, 0]
    return best, nearest, rival


def _one_per_cell(pixels1: Pixels, pixels2: Pixels, rank: FloatArray) -> BoolArray:
    """Return which matches (N,) to keep so that every cell of either image has only the match of lowest rank."""
    keep = np.zeros(len(pixels1), dtype=bool)
    order = np.argsort(rank, kind="stable")
    for pixels in (pixels1, pixels2):
        cell = np.floor(pixels[order] / CELL_PX).astype(np.int64)
        _, position = np.unique(cell, axis=0, return_index=True)
        order = order[np.sort(position)]
    keep[order] = True
    return keep


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
