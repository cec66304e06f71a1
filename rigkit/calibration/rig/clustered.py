"""The covariance of a rig with the frame as the unit that is independent: whatever happens inside a frame.

A frame is one moment: what all cameras saw of all boards then. Light, a board that bends, cameras that are not quite of
one moment touch all of it, so the frames are the clusters of `rigkit.calibration.clustered`; the unknowns are all
intrinsics, mounts and places of boards, and the boards' warps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.clustered import Clustered, clustered_covariance
from rigkit.calibration.normal_equations import NormalEquations
from rigkit.calibration.rig.solver import pose_jacobians, with_rig_priors
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
    information, score = _by_frame(normal.products, observations, state, frame)
    n = score.shape[1]
    coupling, back = normal.gp[:, :n], np.swapaxes(normal.covariance[1][..., :n], -1, -2)
    np.subtract.at(information, frame, back @ np.swapaxes(coupling, -1, -2))
    np.subtract.at(score, frame, (back @ normal.p[..., None])[..., 0])
    nothing = replace(normal, gg=np.zeros_like(normal.gg), g=np.zeros_like(normal.g))
    prior = with_rig_priors(nothing, observations, state, sigma_px).gg[:n, :n]
    return clustered_covariance(unit[:n, :n], information, score, prior, sigma_px)


def _by_frame(
    products: Sequence[FloatArray], observations: RigObservations, state: RigState, frame: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return what every frame adds to the normal equations of the globals, released corners held, (frames, n, n)
    and (frames, n), from the products of the views of each camera."""
    layout = state.layout(observations)
    warps = observations.shape.basis.shape[-1] if layout.shape.stop > layout.shape.start else 0
    n = layout.shape.start + warps
    information, score = np.zeros((int(frame.max()) + 1, n, n)), np.zeros((int(frame.max()) + 1, n))
    for c, own in enumerate(observations.cameras):
        alone = state.of_camera(c, observations)
        product = products[c]
        p = alone.camera.parameters.size + warps
        by = pose_jacobians(observations, state, c, alone.translation_mm)
        at = frame[observations.frame[c]]
        for b in np.unique(own.board).tolist():
            # Views of one board touch the same unknowns: its place, their camera and its mount.
            views = np.flatnonzero(own.board == b)
            runs = [(layout.mounts[c], by.mount), (layout.boards[b], by.place)]
            moved = [(run, how[views]) for run, how in runs if run is not None and how is not None]
            direct = (layout.cameras[c], slice(layout.shape.start, n))
            index = np.concatenate([np.arange(r.start, r.stop) for r in (*direct, *(r for r, _ in moved))])
            follow = np.zeros((len(views), p + 7, len(index) + 1))
            follow[:, :p, :p] = np.eye(p)
            follow[:, -1, -1] = 1.0
            for k, (_, how) in enumerate(moved):
                follow[:, p : p + 6, p + 6 * k : p + 6 * k + 6] = how
            both = np.swapaxes(follow, -1, -2) @ product[views] @ follow
            np.add.at(information, (at[views, None, None], index[:, None], index), both[:, :-1, :-1])
            np.add.at(score, (at[views, None], index), both[:, :-1, -1])
    return information, score
