"""Grow affine correspondences over surfaces: each predicts its neighbours, which are then aligned in the images.

Best-first match propagation (M. Lhuillier and L. Quan, "Match Propagation for Image-Based Modeling and Rendering", PAMI
2002), extended by the affinity to follow slanted and rotated surfaces: from a pair (q1, q2, A) the neighbour q1 + d is
predicted at q2 + A d with the same A. It works with any central cameras: epipolar lines are computed for each pixel,
and images are not rectified.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.refine_patches import patch_pyramid, patch_rules
from rigkit.cameras.base import Camera
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Mat3, Pixels
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.patches import EpipolarKnowledge, Pyramid, grown, starts_of

HALF_WIDTH = 7
"""Half side of a patch in px: larger ones cross edges of surfaces, smaller ones have too little texture."""
COARSEST = 2
"""Coarsest pyramid level for patches with little texture: four times the half side."""
MIN_CORRELATION = 0.9
MAX_GROWTH_MOVE_PX = 2.0
"""Largest distance of a patch from its prediction."""
MAX_SIGMA_PX = 0.15
"""Largest standard deviation along any direction; beyond, a patch slides along an edge."""
MAX_SIGMA_ON_LINE_PX = 0.3
"""The same if a patch can only move along its epipolar line; beyond, a sweep is more accurate."""
GROWN_SETTLED_PX = 0.03
"""Step of a patch's border at which the alignment ends: below the interpolation error (`FLOOR_PX`), and the next step
would be several times smaller."""
RETURN_SETTLED_PX = 0.1
"""The same for growing back: a tenth of MAX_RETURN_PX."""
MAX_TRIES = 3
"""Attempts at each node, from different neighbours."""
MAX_RETURN_PX = 1.0
"""Largest distance to its start of a pair that is grown back from image 2: the left-right check of stereo."""
RAY_SPACING_PX = 8.0
"""Spacing of the ray grid; bicubic interpolation is accurate to 1e-4 px even for strong fisheye lenses."""


@dataclass(frozen=True, eq=False, slots=True)
class GrowingView:
    """An image to grow in: the camera, grey levels, the pyramid, and the rays on a coarse grid."""

    camera: Camera
    grey: NDArray[np.generic]
    pyramid: Pyramid
    size_px: tuple[int, int]
    rays: FloatArray

    @classmethod
    def of(cls, grey: NDArray[np.generic], camera: Camera) -> GrowingView:
        """Return the view of an image (H, W), grey levels 0 to 255."""
        height, width = grey.shape
        # One node more on every side: bicubic interpolation reads four.
        counts = int(np.ceil(width / RAY_SPACING_PX)) + 2, int(np.ceil(height / RAY_SPACING_PX)) + 2
        at = np.stack(np.meshgrid(*(RAY_SPACING_PX * np.arange(n) for n in counts)), axis=-1)
        rays, valid = camera.unproject(at)
        return cls(camera, grey, patch_pyramid(grey), (width, height), np.where(valid[..., None], rays, np.nan))

    def nodes(self, step: int) -> Pixels:
        """Return the pixels (R, C, 2) every `step` px."""
        width, height = self.size_px
        return np.stack(np.meshgrid(*(np.arange(0.0, n, step) for n in (width, height))), axis=-1)


class PosedViews(NamedTuple):
    """Two images to grow in, and the relative pose of their cameras."""

    view1: GrowingView
    view2: GrowingView
    cam2_from_cam1: Rigid3

    def project(self, rays: FloatArray, inverse: FloatArray) -> tuple[Pixels, BoolArray]:
        """Return the pixels (..., 2) in image 2 of points at inverse ranges (...) on rays (..., 3) of camera 1, and a
        mask of those that camera 2 sees."""
        pose = self.cam2_from_cam1
        return self.view2.camera.project(rays @ pose.rotation.T + inverse[..., None] * pose.translation_mm)


@dataclass(frozen=True, slots=True)
class EpipolarConstraint:
    """The epipolar constraint on pairs.

    Attributes
    ----------
    E21 : essential matrix.
    max_distance_px : largest epipolar distance of a pair.
    sigma_px, sigma_A : standard deviations of pixels and affinities about the constraint; infinite: it is not used for
        the alignment.
    """

    E21: Mat3
    max_distance_px: float
    sigma_px: float = np.inf
    sigma_A: float = np.inf

    def swapped(self) -> EpipolarConstraint:
        """Return the constraint for the images in reverse order."""
        return replace(self, E21=self.E21.T)


def only(keep: BoolArray, values: FloatArray) -> FloatArray:
    """Return the values (R, C, ...) of the nodes `keep` (R, C), NaN at the others."""
    return np.where(keep.reshape(*keep.shape, *(1,) * (values.ndim - 2)), values, np.nan)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class GrownPatches:
    """Pairs on a grid of nodes in image 1, each at or close to its node; NaN without a pair.

    Attributes
    ----------
    step : px between nodes.
    pixels1, pixels2 : (R, C, 2); A21 : (R, C, 2, 2).
    correlation, coarser : (R, C) correlation of the patches, and pyramid level of their alignment; both zero for pairs
        of a sweep.
    covariance : (R, C, 6, 6) of (u2, v2, a11, a12, a21, a22), from the patches only.
    """

    step: int
    pixels1: Pixels
    pixels2: Pixels
    A21: Affines
    correlation: FloatArray
    coarser: FloatArray
    covariance: FloatArray

    @property
    def valid(self) -> BoolArray:
        """Mask (R, C) of the nodes with a pair."""
        return np.isfinite(self.correlation)

    @property
    def swept(self) -> BoolArray:
        """Mask (R, C) of the nodes whose pair is from a sweep."""
        return np.asarray(self.correlation == 0.0)

    def __len__(self) -> int:
        return int(self.valid.sum())

    def offsets(self) -> FloatArray:
        """Return by how much (R, C, 2) px the pixels in image 1 are from their nodes."""
        rows, columns = np.indices(self.valid.shape)
        return np.asarray(self.pixels1 - self.step * np.stack([columns, rows], axis=-1))

    def centred(self) -> GrownPatches:
        """Return the pairs, each moved from its node to the point of its patch with the least variance.

        A patch measures the surface at its texture. Close to the edge of a near surface that is the edge, not the far
        surface at the node.
        """
        at = self.valid
        covariance, A21 = self.covariance[at], self.A21[at]
        # The point q2 + A d with the least trace of its covariance.
        of_A = covariance[:, 2:4, 2:4] + covariance[:, 4:6, 4:6]
        with_place = covariance[:, 2:4, 0] + covariance[:, 4:6, 1]
        move = -np.linalg.solve(of_A, with_place[..., None])[..., 0]
        length = np.linalg.norm(move, axis=1, keepdims=True)
        most = HALF_WIDTH * 2.0 ** self.coarser[at][:, None]
        move *= np.minimum(1.0, most / np.maximum(length, 1e-9))
        moved = np.broadcast_to(np.eye(6), covariance.shape).copy()
        moved[:, 0, 2:4] = moved[:, 1, 4:6] = move
        pixels1, pixels2, spread = self.pixels1.copy(), self.pixels2.copy(), self.covariance.copy()
        pixels1[at] += move
        pixels2[at] += np.einsum("nij,nj->ni", A21, move)
        spread[at] = moved @ covariance @ np.swapaxes(moved, 1, 2)
        return replace(self, pixels1=pixels1, pixels2=pixels2, covariance=spread)

    def where(self, keep: BoolArray) -> GrownPatches:
        """Return only the pairs of the nodes `keep` (R, C)."""
        names = ("pixels2", "A21", "correlation", "coarser", "covariance")
        known: dict[str, Any] = {name: only(keep, getattr(self, name)) for name in names}
        return replace(self, **known)

    def correspondences(self) -> Correspondences:
        """Return the pairs in the order of their nodes, row by row."""
        at = self.valid
        variances = np.einsum("nii->ni", self.covariance[at])
        sigma_px, sigma_A = np.sqrt(variances[:, :2].mean(axis=1)), np.sqrt(variances[:, 2:].mean(axis=1))
        return Correspondences(self.pixels1[at], self.pixels2[at], self.A21[at], None, sigma_px, sigma_A)


def grow(
    view1: GrowingView,
    view2: GrowingView,
    seeds: Correspondences,
    *,
    step: int,
    known: EpipolarConstraint | None = None,
    settled_px: float = GROWN_SETTLED_PX,
    wanted: BoolArray | None = None,
) -> GrownPatches:
    """Return the pairs that grow from `seeds`, which have affinities, on a grid every `step` px of image 1.

    Alignment ends when a patch's border moves by less than `settled_px`. With `wanted` (mask (R, C)) pairs grow only at
    these nodes.
    """
    at = view1.nodes(step)
    rays, seen = view1.camera.unproject(at)
    rays = np.where((seen if wanted is None else seen & wanted)[..., None], rays, np.nan)
    jacobians = view1.camera.ray_jacobian(at)
    line = known if known is not None else EpipolarConstraint(np.zeros((3, 3)), np.inf)
    knowledge = EpipolarKnowledge.make(
        view2.rays,
        RAY_SPACING_PX,
        line.E21,
        sigma=line.sigma_px,
        sigma_A=line.sigma_A,
        max_distance=line.max_distance_px,
    )
    rules = patch_rules(
        HALF_WIDTH,
        coarsest=COARSEST,
        max_move=MAX_GROWTH_MOVE_PX,
        min_correlation=MIN_CORRELATION,
        settled_px=settled_px,
        max_sigma=MAX_SIGMA_ON_LINE_PX if np.isfinite(line.sigma_px) else MAX_SIGMA_PX,
    )
    assert seeds.A21 is not None
    starts = starts_of(seeds.pixels1, seeds.pixels2, seeds.A21)
    starts = starts[np.isfinite(starts).all(axis=1)]
    found = grown(view1.pyramid, view2.pyramid, knowledge, rules, rays, jacobians, step, MAX_TRIES, starts)
    shape = at.shape[:2]
    return GrownPatches(
        step=step,
        pixels1=at,
        pixels2=found.pixels2.reshape(*shape, 2),
        A21=found.A21.reshape(*shape, 2, 2),
        correlation=found.correlation.reshape(shape),
        coarser=found.coarser.reshape(shape),
        covariance=found.covariance.reshape(*shape, 6, 6),
    )


def grow_in_both_directions(
    view1: GrowingView, view2: GrowingView, seeds: Correspondences, *, step: int, known: EpipolarConstraint
) -> GrownPatches:
    """Return the pairs that grow from `seeds` and lead back to their nodes when grown from image 2.

    Occluded pixels and repeated texture mostly lead elsewhere, or nowhere.
    """
    there = grow(view1, view2, seeds, step=step, known=known)
    at = there.valid
    pixels2 = there.pixels2[at]
    A12 = np.asarray(np.linalg.inv(there.A21[at]), dtype=np.float64)
    ends = Correspondences(pixels2, there.pixels1[at], A12, None, None, None)
    width, height = view2.size_px
    column, row = np.rint(pixels2 / step).astype(np.int64).T
    node = np.clip(row, 0, (height - 1) // step), np.clip(column, 0, (width - 1) // step)
    wanted = np.zeros(((height - 1) // step + 1, (width - 1) // step + 1), dtype=bool)
    wanted[node] = True
    back = grow(view2, view1, ends, step=step, known=known.swapped(), settled_px=RETURN_SETTLED_PX, wanted=wanted)
    found = back.pixels2[node] + np.einsum("nij,nj->ni", back.A21[node], pixels2 - back.pixels1[node])
    keep = at.copy()
    # Pairs that do not grow back have a NaN distance.
    keep[at] = np.linalg.norm(found - there.pixels1[at], axis=1) < MAX_RETURN_PX
    return there.where(keep)
