"""Cluster-robust covariance of all unknowns of a rig, with frames as the independent units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.covariance import GlobalCovariance
from rigkit.calibration.rig.solving.pose_jacobians import pose_products
from rigkit.calibration.rig.solving.solver import with_rig_priors
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.solving.solver import Solution
from rigkit.core.arrays import IntArray
from rigkit.core.errors import DegenerateError


def frame_covariance(
    observations: RigObservations, solution: Solution[RigState], sigma_px: float, frames: IntArray
) -> tuple[GlobalCovariance, float]:
    """Return the covariance of the solution, and the standard deviation of a corner from all residuals; `frames` (F,)
    are the indices of the poses' frames in order of time, `sigma_px` is the prior standard deviation of a corner.

    Raises DegenerateError where there are fewer corners than unknowns.
    """
    state, normal = solution.state, solution.normal
    sigma = residual_sigma(observations, solution, sigma_px)
    n = state.layout(observations).shape.start + observations.shape.basis.shape[-1]
    nothing = replace(normal, gg=np.zeros_like(normal.gg), g=np.zeros_like(normal.g))
    prior = with_rig_priors(nothing, observations, state, sigma).gg[:n, :n]
    products = pose_products(observations, state, normal.products)
    return GlobalCovariance.of(normal, products, prior, frames, sigma, in_order=True), sigma


def residual_sigma(observations: RigObservations, solution: Solution[RigState], sigma_px: float) -> float:
    """Return the standard deviation of a corner of median quality, from the residuals and their degrees of freedom.

    Raises DegenerateError where there are none.
    """
    state, normal = solution.state, solution.normal
    layout = state.layout(observations)
    poses = int((np.einsum("fii->f", normal.pp) > 0.0).sum())
    # The prior of an unknown of the shape counts as a measurement, so that both cancel.
    unknowns = layout.shape.start + 6 * poses
    freedom = 2 * observations.corner_count - unknowns
    if freedom <= 0:
        raise DegenerateError("rig: fewer corners than unknowns; take more frames")
    total = float(normal.costs.sum())
    if state.unknowns.size:
        total += sigma_px**2 * float(((state.unknowns / observations.shape.sigma) ** 2).sum())
    return float(np.sqrt(total / freedom))
