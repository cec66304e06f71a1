"""The result of a solved rig: covariances, each camera's calibration in the rig, the places of mounted boards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.assemble import board_shapes, view_results
from rigkit.calibration.certainty.covariance import GlobalCovariance
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.pupil import SolvedPupil, without_pupil
from rigkit.calibration.rig.board_rig import BoardRig, MountedBoard
from rigkit.calibration.rig.certainty.displaced import lens_modes
from rigkit.calibration.rig.certainty.frame_covariance import frame_covariance
from rigkit.calibration.rig.certainty.solved_again import between_rig_models, readout_error
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.result import RigCalibration, RigCamera
from rigkit.calibration.rig.solving.lags import lags_of
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.calibration.rig.solving.pose_jacobians import pose_jacobians
from rigkit.calibration.rig.solving.shape import shape_error
from rigkit.calibration.rig.solving.shutters import readouts_of
from rigkit.calibration.rig.solving.state import RigState
from rigkit.calibration.solving.clustered import Clustered, effective_freedom, widening
from rigkit.cameras.moving_pupil import PUPIL_TERMS, NearCamera, far_camera
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.geometry.rigid3 import Rigid3


def assemble_rig(
    joint: JointRig, heldout: tuple[float | None, tuple[float | None, ...]]
) -> tuple[RigCalibration, list[FarProjection]]:
    """Return the rig, and the uncertainty of the projection of each camera; `heldout` is the held-out error, over all
    cameras and of each.

    Raises DegenerateError where there are fewer corners than unknowns.
    """
    observations, state, normal = joint.observations, joint.solution.state, joint.solution.normal
    layout = state.layout(observations)
    known, sigma = frame_covariance(observations, joint.solution, joint.sigma_px, joint.frames)
    overdispersion = known.clustered.overdispersion
    reported = _lenses_and_mounts(layout, state)
    wider = widening(effective_freedom(known.clustered.freedom, overdispersion, len(reported)))
    extra = _error_of_held(joint, layout, normal.covariance[0], wider)
    off = shape_error(observations, state, sigma * overdispersion)
    extra[: len(off), : len(off)] += np.outer(off, off)
    by_readouts, readout_sigmas = readout_error(joint)
    extra += by_readouts
    covariance = known.covariance
    extra += between_rig_models(joint, np.sqrt(np.diag(covariance + extra)))
    covariance += extra
    boards = observations.cameras[0].boards
    points = observations.shape.points(state.unknowns)
    first_row = observations.cameras[0].first_row
    shapes = {b.board_id: points[first_row[i] : first_row[i + 1]] for i, b in enumerate(boards)}
    cameras, squared = _cameras(joint, heldout[1], known, extra)
    everything = np.concatenate(squared)
    # All boards were measured with one ruler: its error does not average out.
    scale = max((b.square_sigma_mm or 0.0) / min(b.square_x_mm, b.square_y_mm) for b in boards)
    far = [FarProjection.of(camera.calibration) for camera in cameras]
    departures, corners, frames = lens_modes(joint, far, reported, sigma)
    # Of the noise only what is left without the lenses' departures, which are stated beside it.
    frames = min(max(frames, corners / overdispersion**2), 1.0)
    given = covariance - (1.0 - frames) * known.covariance
    rig = RigCalibration(
        cameras=tuple(cameras),
        rms_px=float(np.sqrt(everything.mean())),
        heldout_rms_px=heldout[0],
        covariance=given[np.ix_(reported, reported)],
        pupils=_pupils(joint, layout, given, reported),
        sigma_px=sigma * float(np.sqrt(corners)),
        overdispersion=max(overdispersion * float(np.sqrt(frames / corners)), 1.0),
        freedom=known.clustered.freedom,
        single=joint.views.single,
        convergence=joint.solution.convergence,
        corner_count=everything.size,
        shared_count=joint.shared_count,
        left_out=joint.left_out,
        scale_sigma=scale,
        departures=departures,
        board_rigs=_board_rigs(joint, layout, boards, shapes, covariance, scale, known.clustered),
    )
    lags = lags_of(joint.views.names, state, rig.widening**2 * covariance, layout.lags)
    return replace(rig, lags=lags, readouts=readouts_of(joint.views.names, state, readout_sigmas)), far


def _lenses_and_mounts(layout: Layout, state: RigState) -> IntArray:
    """Return the indices, among the globals, of the parameters of the central lenses and of the mounts: the rows of a
    rig's covariance."""
    lenses = [
        np.arange(run.start, run.start + far_camera(camera).parameters.size)
        for run, camera in zip(layout.cameras, state.cameras, strict=True)
    ]
    return np.concatenate([*lenses, *(np.arange(run.start, run.stop) for run in layout.mounts if run is not None)])


def _pupils(joint: JointRig, layout: Layout, covariance: FloatArray, reported: IntArray) -> dict[str, SolvedPupil]:
    """Return the moving pupils by camera name, with their cross-covariance with the globals `reported`."""
    out = {}
    for name, run, camera in zip(joint.views.names, layout.cameras, joint.solution.state.cameras, strict=True):
        if isinstance(camera, NearCamera):
            own = np.arange(run.stop - PUPIL_TERMS, run.stop)
            out[name] = SolvedPupil(camera.pupil, covariance[np.ix_(own, own)], covariance[np.ix_(reported, own)])
    return out


def _cameras(
    joint: JointRig, heldout: Sequence[float | None], known: GlobalCovariance, extra: FloatArray
) -> tuple[list[RigCamera], list[FloatArray]]:
    """Return the cameras in the rig's solution, and the squared residuals of the corners of each, px^2; `extra` (G, G)
    is the covariance of the globals that the scatter between frames does not include."""
    observations, state = joint.observations, joint.solution.state
    layout = state.layout(observations)
    cameras, squared = [], []
    for c, (name, own) in enumerate(zip(joint.views.names, observations.cameras, strict=True)):
        alone = state.of_camera(c, observations)
        parts = pose_jacobians(observations, state, c, alone.translation_mm)
        frame = known.of_camera(layout.cameras[c], parts, alone.translation_mm, extra)
        residuals, kept = joint.solution.normal.residuals[c], observations.weights[c] > 0.0
        squared.append((residuals.px**2).sum(axis=-1)[kept])
        lens, frame, pupil = without_pupil(alone.camera, frame)
        p = lens.parameters.size
        found = replace(
            joint.views.single[c],
            camera=lens,
            pupil=pupil,
            rms_px=float(np.sqrt(squared[c].mean())),
            heldout_rms_px=heldout[c],
            covariance=frame[:p, :p],
            frame_covariance=frame,
            overdispersion=known.clustered.overdispersion,
            freedom=known.clustered.freedom,
            views=view_results(own, alone, residuals, kept),
            convergence=joint.solution.convergence,
            boards=board_shapes(own, observations.shape, state.unknowns),
        )
        cameras.append(RigCamera(name, Rigid3(state.mount_rotation[c], state.mount_mm[c]), found))
    return cameras, squared


def _error_of_held(joint: JointRig, layout: Layout, unit: FloatArray, wider: float) -> FloatArray:
    """Return the contribution of the prior means of held lenses and mounts to the covariance (G, G) of all globals:
    K W C W K, with the information W of these priors and the covariance C of their means, without departures. That of
    known cameras is widened already, and `wider` is the factor by which quoted sigmas of the rig will be."""
    out = np.zeros_like(unit)
    known, names = joint.known, joint.views.names
    held = zip(names, layout.cameras, joint.views.single, joint.observations.held, strict=False)
    for name, where, alone, (_, information) in held:
        if known is None or name not in known.cameras:
            through = unit[:, where] @ information
            out += through @ alone.near_covariance[:-6, :-6] @ through.T
    if known is not None and known.covariance is not None:
        index = known.index(names, layout)
        through = unit[:, index] * known.weights(joint.observations, layout)[index]
        out += through @ (known.covariance / wider**2) @ through.T
    return out


def _board_rigs(
    joint: JointRig,
    layout: Layout,
    boards: Sequence[Board],
    shapes: dict[str, FloatArray],
    covariance: FloatArray,
    scale: float,
    clustered: Clustered,
) -> tuple[BoardRig, ...]:
    state, places = joint.solution.state, joint.views.places
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
        for c, own in enumerate(joint.views.seen):
            for entry in own.values():
                if entry.key[1] == target and entry.board_id in names:
                    scenes[(c, entry.frame)] = scenes.get((c, entry.frame), 0) + 1
        count = sum(n > 1 for n in scenes.values())
        out.append(BoardRig(placed, covariance[np.ix_(chosen, chosen)], count, scale, freedom))
    return tuple(out)
