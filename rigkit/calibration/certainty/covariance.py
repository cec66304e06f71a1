"""Cluster-robust covariance of all unknowns, and of each camera with the boards' mean motion.

A cluster (`clustered`) is everything seen at one moment: an image of a camera, a frame of a rig. Light, a board that
bends and imperfect synchronisation affect all of it. The cluster-robust part is that of all globals except released
corners, which follow by regression: intrinsics and warps of the boards, in a rig also mounts and places of boards.
`PoseJacobians` describes how the views depend on poses and globals, for a camera alone and for a rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rigkit.calibration.solving.clustered import Clustered, clustered_covariance, reduced_by_cluster, with_block
from rigkit.calibration.solving.normal_equations import NormalEquations
from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.geometry.rotation import skew


@dataclass(frozen=True, eq=False, slots=True)
class PoseJacobians:
    """Derivatives of N board poses in a camera, each with another unknown pose, by these poses and by globals.

    Attributes
    ----------
    views : (N,) indices of the camera's views.
    poses : (N,) index of each view's pose among the unknown poses.
    target : (N, 6, 6) or (6, 6), d pose in the camera (w, dt) / d unknown pose.
    index : (K,) indices of the globals that the views depend on.
    globals : (N, 6, K) d pose in the camera / d those globals.
    """

    views: IntArray
    poses: IntArray
    target: FloatArray
    index: IntArray
    globals: FloatArray

    @classmethod
    def alone(cls, count: int) -> Self:
        """Return those of a camera alone: the unknown poses are the poses in the camera."""
        views = np.arange(count)
        return cls(views, views, np.eye(6), np.zeros(0, dtype=np.int64), np.zeros((count, 6, 0)))


@dataclass(frozen=True, eq=False, slots=True)
class GlobalCovariance:
    """The uncertainty of a solution: its normal equations, priors included, the standard deviation of a corner, and the
    cluster-robust covariance of the first n globals, all but released corners."""

    normal: NormalEquations
    sigma_px: float
    clustered: Clustered

    @classmethod
    def of(
        cls,
        normal: NormalEquations,
        products: FloatArray,
        prior: FloatArray,
        cluster: IntArray,
        sigma_px: float,
        *,
        in_order: bool = False,
    ) -> GlobalCovariance:
        """Return it from the `products` (F, n + 7, n + 7) of every pose as for `reduced_by_cluster`, the information
        `prior` (n, n), the `cluster` of every pose (F,), and the standard deviation of a corner from all residuals;
        `in_order` as for `clustered_covariance`."""
        unit, _, own = normal.covariance
        n = len(prior)
        information, score = reduced_by_cluster(products, n, cluster, own)
        clustered = clustered_covariance(unit[:n, :n], information, score, prior, sigma_px, in_order=in_order)
        return cls(normal, sigma_px, clustered)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of all globals, (G, G)."""
        return self._of(self.normal.covariance[0])

    def of_camera(
        self, lens: slice, parts: Sequence[PoseJacobians], translation_mm: Points, more: FloatArray | None = None
    ) -> FloatArray:
        """Return the covariance (P + 6, P + 6) of the P parameters of a camera and the mean motion (W, T) of its
        boards: it moves a point x in the camera frame by W x x + T, with the means of `motion_of_world`.

        Parameters
        ----------
        lens : slice of the parameters among the globals.
        parts : derivatives of all its V views, with the boards at `translation_mm` (V, 3).
        more : (G, G) further covariance of the globals, added.
        """
        n, unit = len(self.clustered.covariance), self.normal.covariance[0]
        mean, spread = self._mean_motion(parts, translation_mm)
        with_globals = mean @ unit
        joint = np.empty((n + 6, n + 6))
        joint[:n, :n], joint[n:, :n] = unit[:n, :n], with_globals[:, :n]
        joint[:n, n:] = joint[n:, :n].T
        joint[n:, n:] = with_globals @ mean.T + spread
        chosen = np.r_[lens.start : lens.stop, n : n + 6]
        out = np.asarray(self._of(0.5 * (joint + joint.T))[np.ix_(chosen, chosen)])
        if more is None:
            return out
        design = np.concatenate([np.eye(len(unit))[lens], mean])
        return np.asarray(out + design @ more @ design.T)

    def _of(self, unit: FloatArray) -> FloatArray:
        """Return the covariance of unknowns, the globals first, from that for independent corners of unit variance."""
        found = self.clustered
        return with_block(unit * self.sigma_px**2, found.covariance, found.overdispersion**2)

    def _mean_motion(self, parts: Sequence[PoseJacobians], translation_mm: Points) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of the boards' mean motion by the globals, (6, G), and its covariance (6, 6) given the
        globals, for corners of unit variance."""
        _, back, own = self.normal.covariance
        known = self.normal.pp.trace(axis1=-2, axis2=-1) > 0.0
        shown = np.zeros(len(translation_mm), dtype=bool)
        for part in parts:
            shown[part.views] = known[part.poses]
        lever = motion_of_world(translation_mm) * shown[:, None, None] / max(int(shown.sum()), 1)
        mean, each = np.zeros((6, len(self.normal.g))), np.zeros((len(own), 6, 6))
        for part in parts:
            through = lever[part.views] @ part.target
            # pose = -W globals + an independent part.
            mean -= through.transpose(1, 0, 2).reshape(6, -1) @ back[part.poses].reshape(-1, mean.shape[1])
            mean[:, part.index] += (lever[part.views] @ part.globals).sum(axis=0)
            each[part.poses] += through
        return mean, (each @ own @ np.swapaxes(each, -1, -2)).sum(axis=0)


def motion_of_world(translation_mm: Points) -> FloatArray:
    """Return the matrices (V, 6, 6) that convert motions (dw, dt) of boards at `translation_mm` (V, 3) to motions
    (W, T) about the camera.

    A point x in the camera frame that is fixed to the board moves by dw x (x - t) + dt = W x x + T, with W = dw and
    T = dt + t x dw.
    """
    lever = np.zeros((len(translation_mm), 6, 6))
    lever[:] = np.eye(6)
    lever[:, 3:, :3] = skew(translation_mm)
    return lever
