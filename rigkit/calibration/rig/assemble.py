"""Putting a solved rig together as a result: covariances, each camera as the rig has it, the boards' places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.assemble import board_shapes, motion_of_world, view_results
from rigkit.calibration.clustered import Clustered, effective_freedom, with_block
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.between_models import between_rig_models
from rigkit.calibration.rig.board_rig import BoardRig, MountedBoard
from rigkit.calibration.rig.carried import carried
from rigkit.calibration.rig.clustered import clustered_by_frame
from rigkit.calibration.rig.displaced import lens_modes
from rigkit.calibration.rig.flatness import shape_error
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.layout import Layout
from rigkit.calibration.rig.observations import Places
from rigkit.calibration.rig.result import RigCalibration, RigCamera
from rigkit.calibration.rig.state import RigObservations
from rigkit.calibration.uncertainty import FarProjection
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3


def assemble_rig(
    names: Sequence[str],
    single: tuple[Calibration, ...],
    joint: JointRig,
    places: Places,
    heldout: tuple[float | None, tuple[float | None, ...]],
) -> tuple[RigCalibration, list[FarProjection]]:
    """Return the rig, and how sure the projection of each of its cameras is; `heldout` is the error of frames that took
    no part, over all cameras and of each.

    Raises DegenerateError where there are fewer corners than unknowns.
    """
    observations, state, normal = joint.observations, joint.solution.state, joint.solution.normal
    layout = state.layout(observations)
    sigma = residual_sigma(joint)
    unit, back, own = normal.covariance
    clustered = clustered_by_frame(observations, state, normal, unit, joint.frames, sigma)
    overdispersion = clustered.overdispersion
    covariance = with_block(unit * sigma**2, clustered.covariance, overdispersion**2)
    covariance += _error_of_held(joint, names, layout, single, unit)
    off = shape_error(observations, state, sigma * overdispersion)
    covariance[: len(off), : len(off)] += np.outer(off, off)
    covariance += between_rig_models(joint, single, np.sqrt(np.diag(covariance)))
    own = own * (sigma * overdispersion) ** 2
    boards = observations.cameras[0].boards
    points = observations.shape.points(state.unknowns)
    first_row = observations.cameras[0].first_row
    shapes = {b.board_id: points[first_row[i] : first_row[i + 1]] for i, b in enumerate(boards)}
    cameras, squared = [], []
    for c, name in enumerate(names):
        frame = _frame_covariance(observations, joint, layout, c, covariance, back, own)
        of_camera, of_corners = _of_camera(joint, c, single[c], frame)
        squared.append(of_corners)
        of_camera = replace(
            of_camera, heldout_rms_px=heldout[1][c], overdispersion=overdispersion, freedom=clustered.freedom
        )
        cameras.append(RigCamera(name, Rigid3(state.mount_rotation[c], state.mount_mm[c]), of_camera))
    everything = np.concatenate(squared)
    last = layout.mounts[-1] or layout.cameras[-1]
    # One ruler has measured all boards: its error does not average out.
    scale = max((b.square_sigma_mm or 0.0) / min(b.square_x_mm, b.square_y_mm) for b in boards)
    far = [FarProjection.of(camera.calibration) for camera in cameras]
    rig = RigCalibration(
        cameras=tuple(cameras),
        rms_px=float(np.sqrt(everything.mean())),
        heldout_rms_px=heldout[0],
        covariance=covariance[: last.stop, : last.stop],
        sigma_px=sigma,
        overdispersion=overdispersion,
        freedom=clustered.freedom,
        single=single,
        convergence=joint.solution.convergence,
        corner_count=everything.size,
        shared_count=joint.shared_count,
        left_out=joint.left_out,
        scale_sigma=scale,
        departures=lens_modes(observations, joint.solution, far, last.stop),
        board_rigs=_board_rigs(joint, layout, places, boards, shapes, covariance, scale, clustered),
    )
    return rig, far


def _of_camera(
    joint: JointRig, c: int, single: Calibration, frame_covariance: FloatArray
) -> tuple[Calibration, FloatArray]:
    """Return the calibration of camera `c` as the rig has it, and the squared residuals of its corners, px^2."""
    observations, state = joint.observations, joint.solution.state
    alone = state.of_camera(c, observations)
    residuals = joint.solution.normal.residuals[c]
    kept = observations.weights[c] > 0.0
    squared = (residuals.px**2).sum(axis=-1)[kept]
    p = alone.camera.parameters.size
    found = replace(
        single,
        camera=alone.camera,
        rms_px=float(np.sqrt(squared.mean())),
        covariance=frame_covariance[:p, :p],
        frame_covariance=frame_covariance,
        views=view_results(observations.cameras[c], alone, residuals, kept),
        convergence=joint.solution.convergence,
        boards=board_shapes(observations.cameras[c], observations.shape, state.unknowns),
    )
    return found, squared


def _error_of_held(
    joint: JointRig, names: Sequence[str], layout: Layout, single: Sequence[Calibration], unit: FloatArray
) -> FloatArray:
    """Return what the errors of the values near which lenses and mounts are held add to the covariance (G, G) of all
    globals: K W C W K, with the information W by which they are held and the covariance C of those values."""
    out = np.zeros_like(unit)
    known = joint.known
    held = zip(names, layout.cameras, single, joint.observations.held, strict=False)
    for name, where, alone, (_, information) in held:
        if known is None or name not in known.cameras:
            through = unit[:, where] @ information
            out += through @ alone.covariance @ through.T
    if known is not None and known.covariance is not None:
        index = known.index(names, layout)
        through = unit[:, index] * known.weights(joint.observations, layout)[index]
        out += through @ known.covariance @ through.T
    return out


def residual_sigma(joint: JointRig) -> float:
    """Return the standard deviation of a corner of median quality, degrees of freedom counted.

    Raises DegenerateError where there are none.
    """
    observations, normal, state = joint.observations, joint.solution.normal, joint.solution.state
    layout = state.layout(observations)
    poses = int((np.einsum("fii->f", normal.pp) > 0.0).sum())
    # Every unknown of the shape has a prior, which pays for it.
    unknowns = layout.shape.start + 6 * poses
    freedom = 2 * observations.corner_count - unknowns
    if freedom <= 0:
        raise DegenerateError("rig: fewer corners than unknowns; take more frames")
    total = float(normal.costs.sum())
    if state.unknowns.size:
        total += joint.sigma_px**2 * float(((state.unknowns / observations.shape.sigma) ** 2).sum())
    return float(np.sqrt(total / freedom))


def _frame_covariance(
    observations: RigObservations,
    joint: JointRig,
    layout: Layout,
    c: int,
    covariance: FloatArray,
    back: FloatArray,
    own: FloatArray,
) -> FloatArray:
    """Return the covariance of the P parameters of camera `c` and of the mean motion of the boards before it,
    (P + 6, P + 6), as `rigkit.calibration.assemble` has it for a camera alone; from that of all globals and `own`
    (F, 6, 6), what is the poses' own."""
    state = joint.solution.state
    translation = state.of_camera(c, observations).translation_mm
    lever = motion_of_world(translation) / max(len(translation), 1)
    mean, each = np.zeros((6, layout.count)), np.zeros((len(observations.keys), 6, 6))
    for part in carried(observations, state, c, translation):
        through = lever[part.views] @ part.target
        # The targets' poses follow the globals, pose = -W globals + what is their own.
        mean -= np.einsum("vij,vjg->ig", through, back[part.poses])
        mean[:, part.index] += (lever[part.views] @ part.globals).sum(axis=0)
        each[part.poses] += through
    design = np.zeros((len(covariance[layout.cameras[c]]) + 6, layout.count))
    design[:-6, layout.cameras[c]] = np.eye(len(design) - 6)
    design[-6:] = mean
    out = design @ covariance @ design.T
    out[-6:, -6:] += np.einsum("fij,fjk,flk->il", each, own, each)
    return np.asarray(0.5 * (out + out.T))


def _board_rigs(
    joint: JointRig,
    layout: Layout,
    places: Places,
    boards: Sequence[Board],
    shapes: dict[str, FloatArray],
    covariance: FloatArray,
    scale: float,
    clustered: Clustered,
) -> tuple[BoardRig, ...]:
    state = joint.solution.state
    index = {b.board_id: i for i, b in enumerate(boards)}
    freedom = effective_freedom(clustered.freedom, clustered.overdispersion, len(clustered.covariance))
    out = []
    for target in dict.fromkeys(target for target, _ in places.values()):
        names = sorted((n for n, (t, _) in places.items() if t == target and n in index), key=lambda n: n != target)
        placed = tuple(
            MountedBoard(boards[index[n]], shapes[n], Rigid3(state.board_rotation[index[n]], state.board_mm[index[n]]))
            for n in names
        )
        runs = [layout.boards[index[n]] for n in names[1:]]
        chosen = np.concatenate([np.arange(r.start, r.stop) for r in runs if r is not None] or [np.zeros(0)]).astype(
            int
        )
        scenes: dict[tuple[int, str], int] = {}
        for c, own in enumerate(joint.seen):
            for entry in own.values():
                if entry.key[1] == target and entry.board_id in names:
                    scenes[(c, entry.frame)] = scenes.get((c, entry.frame), 0) + 1
        count = sum(n > 1 for n in scenes.values())
        out.append(BoardRig(placed, covariance[np.ix_(chosen, chosen)], count, scale, freedom))
    return tuple(out)
