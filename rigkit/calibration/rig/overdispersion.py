"""How much more the frames of a rig disagree than independent corners would.

Errors of a board that is not quite flat or a lens that is not quite its model are the same for many corners of a
frame: there are fewer independent measurements than corners, and a covariance that counts corners promises too much.
Frames are independent, whatever happens inside them. With H_f and s_f what frame f contributes to the normal equations
of the globals after its poses are eliminated, S their sum, and u_f = S^-1 s_f what the frame pulls the globals by,
independent corners of standard deviation sigma have

    E sum u_f u_f^T = sigma^2 S^-1 (sum H_f - H_f S^-1 H_f) S^-1,

where the second term is what each frame has already pulled the solution to itself. The ratio of the two, measured in
the globals' own covariance, is the overdispersion's square; it has no bias however few the frames are.

Reference: J. G. MacKinnon, M. D. Webb, "Cluster-robust inference: a guide to empirical practice", Journal of
Econometrics 232, 2023.
"""

from __future__ import annotations

import numpy as np

from rigkit.calibration.clustered import RANK
from rigkit.calibration.linearise import view_products
from rigkit.calibration.normal_equations import NormalEquations
from rigkit.calibration.rig.solver import pose_jacobians
from rigkit.calibration.rig.state import RigObservations, RigState
from rigkit.core.arrays import FloatArray, IntArray

__all__ = ["MIN_FRAMES", "frame_overdispersion"]

MIN_FRAMES = 4
"""Fewer frames say nothing about how they differ."""


def frame_overdispersion(
    observations: RigObservations, state: RigState, normal: NormalEquations, frame: IntArray, sigma_px: float
) -> float:
    """Return the overdispersion, a ratio of standard deviations: 1 on average where corners are independent.

    Parameters
    ----------
    normal : at the solution `state`.
    frame : (F,) int, number of the frame of every pose.
    sigma_px : standard deviation of a corner, from all residuals.

    Notes
    -----
    The boards' shape counts as known: it has many unknowns, and mostly its priors hold them.
    """
    if int(frame.max()) + 1 < MIN_FRAMES or not sigma_px > 0.0:
        return 1.0
    information, score = _by_frame(observations, state, frame)
    coupling = normal.gp[:, : score.shape[1]]
    back = coupling @ np.linalg.pinv(normal.pp, hermitian=True)
    np.subtract.at(information, frame, back @ np.swapaxes(coupling, -1, -2))
    np.subtract.at(score, frame, (back @ normal.p[..., None])[..., 0])
    # Scaled to a unit diagonal: parameters differ by many powers of ten. What no view determines says nothing here.
    total = information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), np.finfo(float).tiny))
    unit = np.linalg.pinv(total * scale[:, None] * scale, rcond=RANK, hermitian=True) * scale[:, None] * scale
    found = float(((score @ unit) * score).sum())
    through = information @ unit
    expected = float(np.trace(through, axis1=1, axis2=2).sum() - (through * np.swapaxes(through, 1, 2)).sum())
    return float(np.sqrt(found / expected) / sigma_px) if expected > 0.0 else 1.0


def _by_frame(observations: RigObservations, state: RigState, frame: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return what every frame adds to the normal equations of the globals but for the shape, (frames, G, G) and
    (frames, G)."""
    layout = state.layout(observations)
    n = layout.shape.start
    information, score = np.zeros((int(frame.max()) + 1, n, n)), np.zeros((int(frame.max()) + 1, n))
    for c, own in enumerate(observations.cameras):
        alone = state.of_camera(c, observations)
        product = view_products(own, alone.with_boards_held(), observations.weights[c])
        p = alone.camera.parameters.size
        by = pose_jacobians(observations, state, c, alone.translation_mm)
        at = frame[observations.frame[c]]
        for b in np.unique(own.board).tolist():
            # Views of one board touch the same unknowns: its place, their camera and its mount.
            views = np.flatnonzero(own.board == b)
            runs = [(layout.mounts[c], by.mount), (layout.boards[b], by.place)]
            moved = [(run, how[views]) for run, how in runs if run is not None and how is not None]
            index = np.concatenate([np.arange(r.start, r.stop) for r in (layout.cameras[c], *(r for r, _ in moved))])
            follow = np.zeros((len(views), p + 7, len(index) + 1))
            follow[:, :p, :p] = np.eye(p)
            follow[:, -1, -1] = 1.0
            for k, (_, how) in enumerate(moved):
                follow[:, p : p + 6, p + 6 * k : p + 6 * k + 6] = how
            both = np.swapaxes(follow, -1, -2) @ product[views] @ follow
            np.add.at(information, (at[views, None, None], index[:, None], index), both[:, :-1, :-1])
            np.add.at(score, (at[views, None], index), both[:, :-1, -1])
    return information, score
