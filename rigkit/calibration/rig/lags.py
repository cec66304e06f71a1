"""What cameras without a common trigger have done to a rig: each lags by a time of its own, and boards go on meanwhile.

A lag moves what a camera sees of a frame along the way that the board goes there, which the frames before and after
tell. Boards that go the same way for a while make an error that frames have in common, so that their scatter does not
show it. A step of the solver with a lag a camera says how far that would move lenses and mounts: that far they may be
off, as where boards are not quite what they were taken for (`flatness`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.covariance import PoseJacobians
from rigkit.calibration.rig.flatness import CHANCE_SIGMAS
from rigkit.calibration.rig.pose_jacobians import pose_jacobians, summed_products
from rigkit.calibration.rig.state import RigObservations, RigState
from rigkit.calibration.solving.clustered import reduced_by_cluster
from rigkit.calibration.solving.poses import steps_between
from rigkit.core.arrays import FloatArray, scaled_pinv
from rigkit.core.identifiers import natural_key


def lag_error(
    observations: RigObservations,
    state: RigState,
    products: tuple[FloatArray, ...],
    prior: FloatArray,
    sigma_px: float,
) -> FloatArray:
    """Return by how much the globals but for released corners, (n,), would move if every camera but the first had a
    lag; zero where views agree no better with one than by chance.

    Parameters
    ----------
    products : those of every view of each camera (`view_products`).
    prior : (n, n) information of the priors, px^2.
    sigma_px : standard deviation of a corner, the disagreement of the frames counted in.
    """
    n, lags = len(prior), len(observations.cameras) - 1
    layout, way = state.layout(observations), _ways(observations, state)
    if not lags or not way.any():
        return np.zeros(n)
    each = []
    for c, (own, lens) in enumerate(zip(products, layout.cameras, strict=True)):
        parts = pose_jacobians(observations, state, c, state.of_camera(c, observations).translation_mm)
        if c:
            parts = [_with_lag(part, way, n + c - 1) for part in parts]
        each.append((own, np.r_[lens.start : lens.stop, layout.shape.start : n], parts))
    whole = summed_products(each, len(observations.keys), n + lags)
    information, score = reduced_by_cluster(whole, n + lags, np.arange(len(whole)))
    total = information.sum(axis=0)
    total[:n, :n] += prior
    # At the solution nothing pulls but the lags.
    pull = np.append(np.zeros(n), score.sum(axis=0)[n:])
    step = scaled_pinv(total) @ pull
    if pull @ step < sigma_px**2 * (lags + CHANCE_SIGMAS * np.sqrt(2.0 * lags)):
        return np.zeros(n)
    return np.asarray(step[:n])


def _with_lag(part: PoseJacobians, way: FloatArray, at: int) -> PoseJacobians:
    """Return how views follow, with a lag of their camera among the globals."""
    moved = np.broadcast_to(part.target, (len(part.views), 6, 6)) @ way[part.poses, :, None]
    return replace(part, index=np.append(part.index, at), globals=np.concatenate([part.globals, moved], axis=-1))


def _ways(observations: RigObservations, state: RigState) -> FloatArray:
    """Return how the target of every pose goes on, (F, 6), in a frame's time: half of the way from the frame before to
    the one after, in the order of their names; zero at the ends."""
    keys, out = observations.keys, np.zeros((len(observations.keys), 6))
    for target in dict.fromkeys(target for _, target in keys):
        own = [f for f, key in enumerate(keys) if key[1] == target]
        own.sort(key=lambda f: natural_key(keys[f][0]))
        if len(own) > 2:
            before, after = own[:-2], own[2:]
            out[own[1:-1]] = 0.5 * steps_between(
                (state.frame_rotation[before], state.frame_mm[before]),
                (state.frame_rotation[after], state.frame_mm[after]),
            )
    return out
