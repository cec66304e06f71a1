"""The covariance of a rig with the frame as the unit that is independent: whatever happens inside a frame.

A frame is one moment: what all cameras saw of all boards then. Light, a board that bends, cameras that are not quite of
one moment touch all of it, so the frames are the clusters of `rigkit.calibration.clustered`; the unknowns are all
intrinsics, mounts and places of boards, and the boards' warps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.clustered import Clustered, clustered_covariance, reduced_by_cluster
from rigkit.calibration.normal_equations import NormalEquations
from rigkit.calibration.rig.carried import pose_products
from rigkit.calibration.rig.solver import with_rig_priors
from rigkit.calibration.rig.state import RigObservations, RigState
from rigkit.core.arrays import FloatArray, IntArray


def clustered_by_frame(
    observations: RigObservations,
    state: RigState,
    normal: NormalEquations,
    unit: FloatArray,
    frame: IntArray,
    sigma_px: float,
) -> Clustered:
    """Return the covariance of the first n globals: all but the corners that are released.

    Parameters
    ----------
    normal, unit : at the solution `state`, and the covariance (G, G) of all globals for unit residuals.
    frame : (F,) int, number of the frame of every pose.
    sigma_px : standard deviation of a corner, from all residuals.
    """
    products = pose_products(observations, state, normal.products)
    n = products.shape[-1] - 7
    information, score = reduced_by_cluster(products, n, frame, normal.covariance[2])
    nothing = replace(normal, gg=np.zeros_like(normal.gg), g=np.zeros_like(normal.g))
    prior = with_rig_priors(nothing, observations, state, sigma_px).gg[:n, :n]
    return clustered_covariance(unit[:n, :n], information, score, prior, sigma_px)
