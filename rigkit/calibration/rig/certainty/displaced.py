"""Model inadequacy of the lenses of a rig, and the error of all unknowns with it.

As for a single camera (`certainty.displaced`), but all cameras share the boards' poses, so that mounts change with the
displacements of a lens. The amounts of its modes are unknowns of a `DisplacedCamera`: their columns of the rig's normal
equations, with the boards' shape held, give the change of all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.departures import NOISE_ROUNDS
from rigkit.calibration.certainty.displaced import LensModes, significant_modes, with_amounts
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.solving.pose_jacobians import pose_products
from rigkit.calibration.rig.solving.solver import rig_data
from rigkit.calibration.solving.clustered import products_between, reduced_by_cluster, root_of_inverse, square_of_rest
from rigkit.cameras.moving_pupil import far_camera, with_pupil_of
from rigkit.core.arrays import TINY, FloatArray, IntArray


def lens_modes(
    joint: JointRig, far: Sequence[FarProjection], reported: IntArray, sigma_px: float
) -> tuple[tuple[LensModes, ...], float, float]:
    """Return the model inadequacy of each lens, with the error of the globals `reported` (G,), intrinsics and mounts,
    and which parts of the variances of corners and between frames are left without it.

    `far` are the uncertainties of the cameras' projections in the rig, `sigma_px` is the standard deviation of a corner
    from all residuals. Lenses that are held have the modes of their own calibrations, which determined the values held,
    whatever these images say.
    """
    observations, state, normal = joint.observations, joint.solution.state, joint.solution.normal
    whole = state.layout(observations)
    n = whole.shape.start
    before = {} if joint.known is None else joint.known.departures
    stated = [before.get(name) for name in joint.views.names]
    modes, means = zip(
        *(
            significant_modes(one) if own is None else (own.modes, own.means)
            for one, own in zip(far, stated, strict=True)
        ),
        strict=True,
    )
    lenses = [with_amounts(far_camera(camera), own) for camera, own in zip(state.cameras, modes, strict=True)]
    cameras = tuple(with_pupil_of(lens, camera) for lens, camera in zip(lenses, state.cameras, strict=True))
    held = replace(observations, shape=observations.shape.held(state.unknowns))
    displaced = replace(state, cameras=cameras, unknowns=np.zeros(0))
    data, layout = rig_data(held, displaced), displaced.layout(held)
    ends = [run.start + lens.parameters.size for run, lens in zip(layout.cameras, lenses, strict=True)]
    each = [np.arange(end - own.shape[1], end) for end, own in zip(ends, modes, strict=True)]
    amounts = np.concatenate(each)
    free = np.delete(np.arange(layout.count), amounts)
    if n < len(normal.g):
        normal = replace(normal, gg=normal.gg[:n, :n], gp=normal.gp[:, :n], points_from=None)
    inverse, back, _ = normal.covariance
    by_pose = np.tensordot(back, data.gp[:, amounts], axes=((0, 1), (0, 2)))
    moves = -(inverse @ (data.gg[np.ix_(free, amounts)] - by_pose))
    if joint.known is not None and before:
        # With these modes the values held are wrong, too.
        index, weights = joint.known.index(joint.views.names, whole), joint.known.weights(observations, whole)
        own = [np.zeros((len(index), m.shape[1])) if k is None else k.moves for m, k in zip(modes, stated, strict=True)]
        moves += (inverse[:, index] * weights[index]) @ np.concatenate(own, axis=1)
    parts = np.split(moves[reported], np.cumsum([len(own) for own in each])[:-1], axis=1)
    products = reduced_by_cluster(pose_products(held, displaced, data.products), layout.count, joint.frames)
    rest = _variances_left(*products, free, moves, max(float(data.costs.sum()), TINY), sigma_px)
    return tuple(LensModes(*own) for own in zip(modes, parts, means, strict=True)), *rest


def _variances_left(
    information: FloatArray, score: FloatArray, known: IntArray, moves: FloatArray, square: float, sigma_px: float
) -> tuple[float, float]:
    """Return which parts of the variances of corners and between frames are left when the lenses' departures are taken
    out of the residuals, which have the sum of squares `square` and the standard deviation `sigma_px`.

    `information` (N, T, T) and `score` (N, T) are those of each frame, `moves` (K, M) the changes of the unknowns
    `known` (K,) with the amounts of the modes, which are the other unknowns. Where cameras share the boards' poses,
    residuals tell more of the amounts than each camera's own do: they are estimated anew, a priori with unit variance.
    """
    count = moves.shape[1]
    along = np.zeros((information.shape[1], count))
    along[known] = moves
    along[np.setdiff1d(np.arange(len(along)), known)] = np.eye(count)
    own, by_amount = information[:, known[:, None], known], information @ along
    scores = np.concatenate([by_amount[:, known], score[:, known, None]], axis=2)
    between = products_between(root_of_inverse(own.sum(axis=0)), own, scores)
    whole = np.empty((count + 1, count + 1))
    whole[:-1, :-1] = along.T @ by_amount.sum(axis=0)
    whole[:-1, -1] = whole[-1, :-1] = along.T @ score.sum(axis=0)
    whole[-1, -1] = square
    amounts, at_all = whole[:-1, :-1], between[-1, -1] / own.shape[1]
    variance, rest, frames = max(sigma_px**2, at_all), square, at_all
    for _ in range(NOISE_ROUNDS):
        covariance = np.linalg.inv(amounts / variance + np.eye(count))
        mean = covariance @ whole[:-1, -1] / variance
        second = covariance + np.outer(mean, mean)
        rest = float(np.clip(square_of_rest(whole, second, mean), 0.0, square))
        frames = float(np.clip(square_of_rest(between, second, mean) / own.shape[1], 0.0, at_all))
        variance = max(sigma_px**2 * rest / square, frames, TINY)
    return rest / square, frames / max(at_all, TINY)
