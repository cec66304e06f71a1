"""Model inadequacy of the lenses of a rig, and the error of all unknowns with it.

As for a single camera (`certainty.displaced`), but all cameras share the boards' poses, so that mounts change with the
displacements of a lens. The amounts of its modes are unknowns of a `DisplacedCamera`: their columns of the rig's normal
equations, with the boards' shape held, give the change of all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.displaced import LensModes, significant_modes, with_amounts
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.rig.solving.solver import rig_data
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.solving.solver import Solution
from rigkit.cameras.moving_pupil import far_camera, with_pupil_of
from rigkit.core.arrays import IntArray


def lens_modes(
    observations: RigObservations, solution: Solution[RigState], far: Sequence[FarProjection], reported: IntArray
) -> tuple[LensModes, ...]:
    """Return the model inadequacy of each lens, with the error of the globals `reported` (G,), intrinsics and mounts;
    `far` are the uncertainties of the cameras' projections in the rig."""
    state, normal = solution.state, solution.normal
    n = state.layout(observations).shape.start
    modes = [significant_modes(one) for one in far]
    lenses = [with_amounts(far_camera(camera), own) for camera, own in zip(state.cameras, modes, strict=True)]
    cameras = tuple(with_pupil_of(lens, camera) for lens, camera in zip(lenses, state.cameras, strict=True))
    held = replace(observations, shape=observations.shape.held(state.unknowns))
    displaced = replace(state, cameras=cameras, unknowns=np.zeros(0))
    data, layout = rig_data(held, displaced), displaced.layout(held)
    ends = [run.start + lens.parameters.size for run, lens in zip(layout.cameras, lenses, strict=True)]
    each = [np.arange(end - own.shape[1], end) for end, own in zip(ends, modes, strict=True)]
    amounts = np.concatenate(each)
    known = np.delete(np.arange(layout.count), amounts)
    if n < len(normal.g):
        normal = replace(normal, gg=normal.gg[:n, :n], gp=normal.gp[:, :n], points_from=None)
    inverse, back, _ = normal.covariance
    by_pose = np.tensordot(back, data.gp[:, amounts], axes=((0, 1), (0, 2)))
    moves = -(inverse @ (data.gg[np.ix_(known, amounts)] - by_pose))[reported]
    parts = np.split(moves, np.cumsum([len(own) for own in each])[:-1], axis=1)
    return tuple(LensModes(own, part) for own, part in zip(modes, parts, strict=True))
