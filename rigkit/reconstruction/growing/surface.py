"""Fit points and normals to grown pairs: local planes, robust to neighbours on another surface.

For a plane n . X = d the inverse range 1 / r = m . f, with m = n / d, is exactly linear in the ray f for any central
camera; so is its gradient by the pixel, m . B with B the ray Jacobian. A pair measures both: the range by its position
on the epipolar line, the gradient by its affinity (A = G - h y^T, gradient y / r^2; `affine.normal`). The plane at a
node is fitted to the measurements of the pairs around it, with the covariances of their patches. A robust loss
downweights neighbours on another surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from rigkit.affine.normal import linear_gauge
from rigkit.affine.refine_patches import FLOOR_PX, WINDOW_OF_PATCH, curvature_shift, levels_of_larger, window_variance
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Normals, Points
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import unit
from rigkit.geometry.triangulation import triangulate_rays
from rigkit.kernels.planes import PlaneFits, fitted_planes
from rigkit.optim.local_variances import of_redescending, shrunk_variances
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH
from rigkit.reconstruction.growing.grow import HALF_WIDTH, GrownPatches, only

PLANE_REACH_PX = 2.0 * HALF_WIDTH
"""Half side of the window of nodes that a plane is fitted to: patches further away do not overlap the middle one."""
SMOOTHING_ROUNDS = 5
TURN_OF_LOSS = 2.385
"""Scale of the robust loss, in standard deviations of a component."""
MIN_NODE_SUPPORT = 0.1
"""Least sum of weights over the number of nodes around; below, a plane is fitted to little more than its own node."""
REACH_OF_SWEEP = 2
"""Times as far apart as of patches are curvatures compared of a sweep, whose errors reach further than a plane."""
Row = tuple[float, ...]
SLOPES, BENDS = (-1.0, 1.0), (1.0, -2.0, 1.0)
"""Weights of planes in a row that are compared. Curvature adds to first differences, more edges in between to second
ones: noise is no more than both show. A sweep's errors reach further than a plane and look like curvature, so only
first differences show them."""
OPEN_CURVATURE = 1e-6
"""Least information on a curvature beside a plane, over that without one (a determinant): rounding of nodes in a line
leaves less."""
MIN_COMPARED = 200
"""Least number of pairs of planes whose median ratio is known to a tenth."""
GROUPS_A_DOUBLING = 2
"""Groups of such pairs for each doubling of the variance around them."""
WINDOW_AREA_PX = 4.0 * np.pi * (WINDOW_OF_PATCH * HALF_WIDTH) ** 2
"""Area, px^2, of an image for each independent value after Gaussian windowing."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class NodeMeasurements:
    """The measurement of each node on the grid (R, C); NaN without one.

    Attributes
    ----------
    z : (R, C, 3) inverse range, and its gradient by the pixel.
    covariance : (R, C, 3, 3) of z, from the noise along the epipolar line only.
    frame : (R, C, 3, 3) ray and columns of the ray Jacobian in rows: z = frame m for the plane m . X = 1.
    slope : (R, C) derivative, in px along the epipolar line, by the inverse range.
    swept : (R, C) mask of the nodes whose pair is from a sweep.
    offset : (R, C, 2) px, of the measured points from their nodes, the middle of the windows that measured them.
    window : (R, C) variance of these windows along an axis, px^2.
    """

    z: FloatArray
    covariance: FloatArray
    frame: FloatArray
    slope: FloatArray
    swept: BoolArray
    offset: FloatArray
    window: FloatArray


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class GrownSurface:
    """Fitted planes on the grid (R, C); NaN without one.

    Attributes
    ----------
    points : (R, C, 3) in the frame of camera 1, in the unit of the translation.
    normals : (R, C, 3) unit, towards camera 1.
    plane : (R, C, 3) m of the plane m . X = 1; covariance : (R, C, 3, 3) of m.
    support : (R, C) sum of the weights of the nodes around, over their number.
    """

    points: Points
    normals: Normals
    plane: FloatArray
    covariance: FloatArray
    support: FloatArray

    @property
    def valid(self) -> BoolArray:
        """Mask (R, C) of the nodes with a plane."""
        return np.isfinite(self.plane[..., 0])

    def where(self, keep: BoolArray) -> GrownSurface:
        """Return only the planes of the nodes `keep` (R, C)."""
        known: dict[str, Any] = {f.name: only(keep, getattr(self, f.name)) for f in fields(self)}
        return replace(self, **known)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PairRays:
    """The rays of K grown pairs, which do not depend on the pose.

    Attributes
    ----------
    grown : the pairs; nodes : (K,) row-major indices.
    rays1, rays2 : (K, 3) with the ray Jacobians jacobians1, jacobians2 (K, 3, 2).
    seen : (K,) mask of the pairs in both fields of view.
    """

    grown: GrownPatches
    nodes: IntArray
    rays1: FloatArray
    rays2: FloatArray
    jacobians1: FloatArray
    jacobians2: FloatArray
    seen: BoolArray

    @classmethod
    def of(cls, grown: GrownPatches, camera1: Camera, camera2: Camera) -> PairRays:
        """Return the rays of all pairs."""
        at = grown.valid
        pixels1, pixels2 = grown.pixels1[at], grown.pixels2[at]
        rays1, seen1, jacobians1 = camera1.rays_and_jacobians(pixels1)
        rays2, seen2, jacobians2 = camera2.rays_and_jacobians(pixels2)
        return cls(
            grown=grown,
            nodes=np.flatnonzero(at.ravel()),
            rays1=rays1,
            rays2=rays2,
            jacobians1=jacobians1,
            jacobians2=jacobians2,
            seen=seen1 & seen2,
        )

    def measured(self, cam2_from_cam1: Rigid3) -> NodeMeasurements:
        """Return the measurements of the surface at the nodes."""
        z, along, slope, good = self._values(cam2_from_cam1)
        # d pixel = -h d(1/r) r^2, and along h the same for the affinity and the gradient.
        to_z = np.zeros((len(z), 3, 6))
        with np.errstate(divide="ignore", invalid="ignore"):
            to_z[:, 0, 0:2] = to_z[:, 1, 2::2] = to_z[:, 2, 3::2] = along / slope[:, None]
        covariance = to_z @ (self.grown.covariance[self.grown.valid] + self._model_error()) @ np.swapaxes(to_z, 1, 2)
        good &= np.isfinite(covariance).all(axis=(1, 2))
        return NodeMeasurements(
            z=self._on_grid(z, good),
            covariance=self._on_grid(covariance, good),
            frame=self._on_grid(self._frames(), good),
            slope=self._on_grid(slope, good),
            swept=self.grown.swept,
            offset=self.grown.offsets(),
            window=_window_variance(self.grown),
        )

    def _model_error(self) -> FloatArray:
        """Return the covariance (K, 6, 6) of patches' errors that do not decrease with texture, as noise does.

        Without it patches with strong texture contradict each other, and hardly any plane has support.
        """
        at = self.grown.valid
        place = np.where(self.grown.swept[at], 0.0, FLOOR_PX * 2.0 ** self.grown.coarser[at])
        affinity = np.where(self.grown.swept[at], 0.0, FLOOR_PX / HALF_WIDTH)
        sigmas = np.repeat(np.stack([place, affinity], axis=1), [2, 4], axis=1)
        return np.asarray(sigmas[:, :, None] ** 2 * np.eye(6), np.float64)

    def planes(self, cam2_from_cam1: Rigid3) -> FloatArray:
        """Return m (R, C, 3) of the planes m . X = 1 of each node's own measurement; NaN without one."""
        z, _, _, good = self._values(cam2_from_cam1)
        out = np.full(z.shape, np.nan)
        out[good] = np.linalg.solve(self._frames()[good], z[good][..., None])[..., 0]
        return self._on_grid(out, good)

    def _frames(self) -> FloatArray:
        """Return `frame` (K, 3, 3) of `NodeMeasurements`."""
        return np.concatenate([self.rays1[:, None, :], np.swapaxes(self.jacobians1, 1, 2)], axis=1)

    def _values(self, cam2_from_cam1: Rigid3) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Return z (K, 3), directions (K, 2) of the epipolar lines, slopes (K,), and the mask (K,) of valid ones."""
        B1, B2 = self.jacobians1, self.jacobians2
        points, valid = triangulate_rays(self.rays1, self.rays2, cam2_from_cam1, jacobians1=B1, jacobians2=B2)
        J1, J2 = pair_projection_jacobians(points, self.rays1, B1, self.rays2, B2, cam2_from_cam1)
        G, h, _ = linear_gauge(J1, J2)
        length = np.linalg.norm(h, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / np.linalg.norm(points, axis=1)
            along = h / length[:, None]
            y = np.einsum("nij,ni->nj", G - self.grown.A21[self.grown.valid], along) / length[:, None]
            z = np.concatenate([inverse[:, None], inverse[:, None] ** 2 * y], axis=1)
            return z, along, length / inverse**2, valid & self.seen & np.isfinite(z).all(axis=1)

    def _on_grid(self, values: FloatArray, good: BoolArray) -> FloatArray:
        """Return values (K, ...) on the grid (R, C, ...), NaN if not `good`."""
        shape = self.grown.valid.shape
        out = np.full((shape[0] * shape[1], *values.shape[1:]), np.nan)
        out[self.nodes[good]] = values[good]
        return out.reshape(*shape, *values.shape[1:])


def fit_surface(measured: NodeMeasurements, step: int, shared_px: float = 0.0) -> GrownSurface:
    """Return the planes around all nodes, which are `step` px apart.

    Their covariance is scaled twice. First by the local residuals of the nodes around, as far as these vary by more
    than chance: windows with another surface, a highlight or a bend have larger errors. Then by the disagreement of
    planes that share no node but have similar residuals, because neighbouring patches share pixels. A curvature of the
    surface is fitted along with each plane; the share of it that others around agree on moves the plane.
    Nodes of a sweep are scaled separately, because its errors are correlated over larger distances. `shared_px` is an
    error along the epipolar lines that is common to all nodes around.

    Notes
    -----
    Minimises over m sum_j w_ij (z_j - F_j m)^T C_j^-1 (z_j - F_j m), with w_ij of the Geman-McClure loss on the
    residual of neighbour j, range and gradient. The initial plane and its covariance are the node's own.
    """
    reach = max(2, round(PLANE_REACH_PX / step))
    valid = np.isfinite(measured.z[..., 0])
    covariance = np.where(valid[..., None, None], measured.covariance, np.eye(3))
    fits = fitted_planes(
        measured.z,
        np.linalg.inv(covariance),
        measured.frame,
        offsets=measured.offset,
        windows=measured.window,
        step=step,
        reach=reach,
        rounds=SMOOTHING_ROUNDS,
        turn=TURN_OF_LOSS,
    )
    ray = measured.frame[..., 0, :]
    support = fits.support / (2 * reach + 1) ** 2
    keep = (np.sum(fits.planes * ray, axis=-1) > 0.0) & (support >= MIN_NODE_SUPPORT)
    spread = np.full(fits.normals.shape, np.nan)
    spread[keep] = _inverse(fits.normals[keep])
    # Squares of values with Gaussian correlation have half the correlation area.
    area = _sum_around(valid.astype(np.float64), 2 * reach + 1) * step**2
    freedom = np.maximum(3.0 * area / (0.5 * WINDOW_AREA_PX), 1.0)
    plane, curved, lag = fits.planes.copy(), _curvatures(fits, spread), 2 * reach
    sweep, patches = keep & measured.swept, keep & ~measured.swept
    for alike, stencils, apart in ((sweep, [SLOPES], REACH_OF_SWEEP * lag), (patches, [SLOPES, BENDS], lag)):
        share = _share_of_curvature(curved, alike, apart, lag + 1)
        squares = fits.squares - share * (2.0 - share) * np.sum(curved.bend * curved.pull, axis=-1)
        variances = of_redescending(squares / (3.0 * fits.support), TURN_OF_LOSS)
        noise = _noise(only(alike, fits.planes), spread, variances, freedom, stencils, lag)
        plane[alike] -= (share[..., None] * curved.shift)[alike]
        spread[alike] = (noise[..., None, None] * (spread + share[..., None, None] * curved.covariance))[alike]
    spread += ((shared_px / measured.slope) ** 2)[..., None, None] * ray[..., :, None] * ray[..., None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.sum(plane * ray, axis=-1)
        keep &= inverse > 0.0
        points = ray / inverse[..., None]
        normals = -plane / np.linalg.norm(plane, axis=-1, keepdims=True)
    return GrownSurface(
        points=only(keep, points),
        normals=only(keep, normals),
        plane=only(keep, plane),
        covariance=spread,
        support=only(keep, support),
    )


class _Curvatures(NamedTuple):
    """Curvatures `bend` (R, C, 3) fitted with planes, the sides `pull` (R, C, 3) of their equations: bend . pull is the
    decrease of the squares. Planes are off by `shift` (R, C, 3), with its covariance (R, C, 3, 3) for values of the
    stated noise. Zero where the nodes around do not determine a curvature."""

    bend: FloatArray
    pull: FloatArray
    shift: FloatArray
    covariance: FloatArray


def _curvatures(fits: PlaneFits, spread: FloatArray) -> _Curvatures:
    """Return the curvatures fitted with the planes of the covariances `spread` (R, C, 3, 3), NaN without one."""
    bend, pull, shift = np.zeros((3, *fits.planes.shape))
    covariance = np.zeros(spread.shape)
    by_bend = spread @ fits.mixed
    own = fits.bends - np.swapaxes(fits.mixed, -1, -2) @ by_bend
    # Beside what there is without a plane: what a plane explains, too, leaves rounding.
    diagonal = np.diagonal(fits.bends, axis1=-2, axis2=-1)
    known: BoolArray = np.asarray(np.isfinite(own).all(axis=(-1, -2)) & (diagonal > 0.0).all(axis=-1))
    size = np.sqrt(diagonal[known])
    both = size[:, :, None] * size[:, None, :]
    known[known] = closed = np.linalg.det(own[known] / both) > OPEN_CURVATURE
    by_bend, inverse = by_bend[known], np.linalg.inv(own[known] / both[closed]) / both[closed]
    pull[known] = fits.pull[known]
    bend[known] = (inverse @ pull[known][..., None])[..., 0]
    shift[known] = (by_bend @ bend[known][..., None])[..., 0]
    covariance[known] = by_bend @ inverse @ np.swapaxes(by_bend, 1, 2)
    return _Curvatures(bend, pull, shift, covariance)


def _share_of_curvature(curved: _Curvatures, alike: BoolArray, lag: int, side: int) -> FloatArray:
    """Return the share (R, C) of the curvatures that alike nodes `lag` apart, which share no node around, agree on: the
    sum of their products over that of their squares, of the nodes within `side` nodes.

    Noise has no mean product, so that the share is Wiener's. Nor has what a crease or an edge of depth makes look like
    curvature: across it neighbours have none. So the lesser share, of rows and of columns, counts.
    """
    shares, known = [], alike & curved.pull.any(axis=-1)
    for turned in (False, True):
        bend, pull = (np.swapaxes(v, 0, 1) if turned else v for v in (curved.bend, curved.pull))
        here = known.T if turned else known
        sums, both = np.zeros((2, *here.shape)), here[:-lag] & here[lag:]
        for one, other in ((np.s_[:-lag], np.s_[lag:]), (np.s_[lag:], np.s_[:-lag])):
            for total, neighbour in zip(sums, (other, one), strict=True):
                total[one] += np.where(both, np.sum(pull[one] * bend[neighbour], axis=-1), 0.0)
        product, square = (_sum_around(v, side) for v in sums)
        # Squares that sum to less than that of one noisy value show nothing.
        share = np.clip(product / np.maximum(square, 1.0), 0.0, 1.0)
        shares.append(share.T if turned else share)
    return np.where(alike, np.minimum(*shares), 0.0)


def _sum_around(values: FloatArray, side: int) -> FloatArray:
    return np.asarray(cv2.boxFilter(values, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT))


def _noise(
    plane: FloatArray, spread: FloatArray, variances: FloatArray, freedom: FloatArray, stencils: Sequence[Row], lag: int
) -> FloatArray:
    """Return the variances (R, C) of the measurements over those stated, never less than these, from the `variances` of
    their residuals with `freedom` and how much planes that share no node, `lag` apart, disagree."""
    alike = np.isfinite(plane[..., 0])
    local = only(alike, np.zeros(alike.shape))
    local[alike] = shrunk_variances(variances[alike], freedom[alike])
    stated = local[..., None, None] * spread
    scale = np.min([_disagreement(plane, stated, local, lag, row) for row in stencils], axis=0)
    return np.asarray(np.maximum(local * np.maximum(scale, 1.0) ** 2, 1.0))


def _disagreement(plane: FloatArray, covariance: FloatArray, scatter: FloatArray, lag: int, stencil: Row) -> FloatArray:
    """Return the ratio (R, C) of observed to predicted differences, by the `stencil`, between normals of nodes `lag`
    apart; 1 without any.

    It is a function of `scatter` (R, C), the local residual variance: errors that neighbours share, as a highlight or
    an edge in all their windows, occur where residuals are large, but do not contribute to these.
    """
    normals = plane / np.linalg.norm(plane, axis=-1, keepdims=True)
    across = np.eye(3) - normals[..., :, None] * normals[..., None, :]
    variance = np.einsum("...ij,...jk,...ik->...", across, covariance, across) / np.sum(plane**2, axis=-1)
    ratios, scatters, span = [], [], lag * (len(stencil) - 1)
    for turned in (False, True):
        n, v, s = (np.swapaxes(values, 0, 1) if turned else values for values in (normals, variance, scatter))
        places = [np.s_[k * lag : max(len(n) - span, 0) + k * lag] for k in range(len(stencil))]
        off = np.sum([w * n[at] for w, at in zip(stencil, places, strict=True)], axis=0)
        # Bends are what is across the mean; slopes are so anyhow.
        middle = unit(np.sum([n[at] for at in places], axis=0))
        off -= np.sum(off * middle, axis=-1, keepdims=True) * middle
        angle = 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(off, axis=-1), 1.0))
        both = np.sum([w * w * v[at] for w, at in zip(stencil, places, strict=True)], axis=0)
        weighted = np.sum([w * w * (v * s)[at] for w, at in zip(stencil, places, strict=True)], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios.append((angle / np.sqrt(both)).ravel())
            scatters.append((weighted / both).ravel())
    ratio, at = np.concatenate(ratios), np.concatenate(scatters)
    known = np.isfinite(ratio) & (at > 0.0)
    if not known.any():
        return np.ones(scatter.shape)
    ratio, at = ratio[known], at[known]
    group = np.rint(np.log2(at) * GROUPS_A_DOUBLING)
    groups = [group == g for g in np.unique(group)]
    enough = [g for g in groups if g.sum() >= MIN_COMPARED] or [group == group]
    # The angle has two components.
    scale = [float(np.median(ratio[g])) * np.sqrt(2.0) / MEDIAN_OF_RAYLEIGH for g in enough]
    return np.asarray(np.interp(scatter, [float(np.median(at[g])) for g in enough], scale))


def _inverse(normal: FloatArray) -> FloatArray:
    """Return the inverses of normal matrices (N, 3, 3), scaled to unit diagonal for accuracy."""
    scale = 1.0 / np.sqrt(np.einsum("nii->ni", normal))
    both = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(normal * both) * both)


def correct_curvature(grown: GrownPatches, camera1: Camera, camera2: Camera, cam2_from_cam1: Rigid3) -> GrownPatches:
    """Return the pairs, at their nodes or `centred`, with their pixels in image 2 corrected for the curvature of the
    surface in their alignment windows (`curvature_shift`)."""
    planes = PairRays.of(grown, camera1, camera2).planes(cam2_from_cam1)
    at = grown.valid & np.isfinite(planes[..., 0])
    place, off, variance = grown.pixels1[at], grown.offsets()[at], _window_variance(grown)[at]
    pixels2 = grown.pixels2.copy()
    pixels2[at] -= curvature_shift(place, planes[at], variance, (camera1, camera2), cam2_from_cam1, off)
    return replace(grown, pixels2=pixels2)


def _window_variance(grown: GrownPatches) -> FloatArray:
    """Return the variance (R, C) of the alignment windows along an axis, px^2 of image 1; none for pairs of a sweep."""
    out, at = np.zeros(grown.valid.shape), grown.valid & ~grown.swept
    out[at] = window_variance(HALF_WIDTH) * 4.0 ** (grown.coarser[at] + levels_of_larger(grown.A21[at]))
    return out
