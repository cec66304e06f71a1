"""The covariance of all that was solved for, from what repeats, and of each camera with the boards' mean motion.

One moment is what repeats (`clustered`): of a camera its image, of a rig its frame, whatever all cameras saw of all
boards then. Light, a board that bends, cameras that are not quite of one moment touch all of it. The unknowns are the
globals, but for released corners, which follow: the intrinsics and warps of the boards, in a rig also mounts and places
of boards. Nothing here asks which it is: how views follow from poses and globals is `PoseJacobians`.
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
    """How N views of one camera, of different poses each, follow from the poses and the globals.

    Attributes
    ----------
    views : (N,) which of the camera's.
    poses : (N,) the pose of each among those solved for.
    target : (N, 6, 6) or (6, 6), how the pose in the camera (w, dt) follows from that.
    index : (K,) the globals that it follows beside it.
    globals : (N, 6, K) how.
    """

    views: IntArray
    poses: IntArray
    target: FloatArray
    index: IntArray
    globals: FloatArray

    @classmethod
    def alone(cls, count: int) -> Self:
        """Return the views of a camera alone: the poses are those in the camera."""
        views = np.arange(count)
        return cls(views, views, np.eye(6), np.zeros(0, dtype=np.int64), np.zeros((count, 6, 0)))


@dataclass(frozen=True, eq=False, slots=True)
class GlobalCovariance:
    """How sure a solution is: the normal equations there, priors included, the standard deviation of a corner, and what
    the clusters say of the first n globals, all but released corners."""

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
        """Return it from the `products` (F, n + 7, n + 7) of every pose, as `reduced_by_cluster` has them, the
        information (n, n) of the priors, the number of the cluster of every pose, (F,), and the standard deviation of a
        corner from all residuals; `in_order` as for `clustered_covariance`."""
        unit, _, own = normal.covariance
        n = len(prior)
        information, score = reduced_by_cluster(products, n, cluster, own)
        clustered = clustered_covariance(unit[:n, :n], information, score, prior, sigma_px, in_order=in_order)
        return cls(normal, sigma_px, clustered)

    @property
    def covariance(self) -> FloatArray:
        """That of all globals, (G, G)."""
        return self._of(self.normal.covariance[0])

    def of_camera(
        self, lens: slice, parts: Sequence[PoseJacobians], translation_mm: Points, more: FloatArray | None = None
    ) -> FloatArray:
        """Return the covariance (P + 6, P + 6) of the P parameters of a camera and of the mean motion (w, t) of the
        boards before it. They move a point x in the camera frame by W x x + T, W and T the means of `motion_of_world`.

        Parameters
        ----------
        lens : where the parameters stand among the globals.
        parts : how all its V views follow, with the boards at `translation_mm` (V, 3).
        more : (G, G) what is not sure of the globals beside.
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
        """Return the covariance of unknowns, the globals first, from theirs for independent corners of variance one."""
        found = self.clustered
        return with_block(unit * self.sigma_px**2, found.covariance, found.overdispersion**2)

    def _mean_motion(self, parts: Sequence[PoseJacobians], translation_mm: Points) -> tuple[FloatArray, FloatArray]:
        """Return how the mean motion of the boards follows the globals, (6, G), and the covariance of what is its own,
        (6, 6), for corners of variance one."""
        _, back, own = self.normal.covariance
        known = self.normal.pp.trace(axis1=-2, axis2=-1) > 0.0
        shown = np.zeros(len(translation_mm), dtype=bool)
        for part in parts:
            shown[part.views] = known[part.poses]
        lever = motion_of_world(translation_mm) * shown[:, None, None] / max(int(shown.sum()), 1)
        mean, each = np.zeros((6, len(self.normal.g))), np.zeros((len(own), 6, 6))
        for part in parts:
            through = lever[part.views] @ part.target
            # Poses follow the globals, pose = -W globals + what is their own.
            mean -= through.transpose(1, 0, 2).reshape(6, -1) @ back[part.poses].reshape(-1, mean.shape[1])
            mean[:, part.index] += (lever[part.views] @ part.globals).sum(axis=0)
            each[part.poses] += through
        return mean, (each @ own @ np.swapaxes(each, -1, -2)).sum(axis=0)


def motion_of_world(translation_mm: Points) -> FloatArray:
    """Return how the motions (dw, dt) of boards at `translation_mm` (V, 3) become motions (W, T) of the world,
    (V, 6, 6).

    A point x in the camera frame that sticks to the board moves by dw x (x - t) + dt = W x x + T, with W = dw and
    T = dt + t x dw.
    """
    lever = np.zeros((len(translation_mm), 6, 6))
    lever[:] = np.eye(6)
    lever[:, 3:, :3] = skew(translation_mm)
    return lever
