"""The joint least squares of a rig, on top of the normal equations of single cameras.

A camera sees board b of the target of frame f at  R = Rc Rf Rb,  t = Rc (Rf tb + tf) + tc. Perturbations from the left,
(w, dt) of the target's pose, (e, ds) of the camera's mount and (b, du) of the board's place on its target, move the
board in the camera by

    w_cam = Rc w + e + Rc Rf b,      dt_cam = Rc dt + (Rc w) x (Rc Rf tb) + ds + e x (t - tc) + Rc Rf du,

so the six columns of each view's own pose are carried over to target, mount and place by 6x6 matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.linearise import normal_equations
from rigkit.calibration.normal_equations import NormalEquations
from rigkit.calibration.poses import refine_each
from rigkit.calibration.result import Convergence
from rigkit.calibration.rig.state import RigObservations, RigState
from rigkit.calibration.solver import COST_TOLERANCE, Linearised, minimise
from rigkit.core.arrays import FloatArray, IntArray, Mat3, Points
from rigkit.geometry.rotation import log_so3, skew


@dataclass(frozen=True, eq=False, slots=True)
class PoseJacobians:
    """How a view's own pose (w_cam, dt_cam) follows from the poses of target, mount and place: (V, 6, 6) or (6, 6)
    each; `place` is None where no target has several boards."""

    target: FloatArray
    mount: FloatArray
    place: FloatArray | None


@dataclass(frozen=True, eq=False, slots=True)
class RigSolution:
    """The state found, the normal equations there with all priors, and how the solver ended."""

    state: RigState
    normal: NormalEquations
    convergence: Convergence


def pose_jacobians(observations: RigObservations, state: RigState, c: int, translation_mm: FloatArray) -> PoseJacobians:
    """Return how the views of camera `c`, at `translation_mm` (V, 3) from it, follow from the rig's poses."""
    turn = state.mount_rotation[c]
    target = np.zeros((6, 6))
    target[:3, :3] = target[3:, 3:] = turn
    mount = np.zeros((len(translation_mm), 6, 6))
    mount[:] = np.eye(6)
    mount[:, 3:, :3] = -skew(translation_mm - state.mount_mm[c])
    if not observations.tied:
        return PoseJacobians(target, mount, None)
    place = np.zeros_like(mount)
    place[:, :3, :3] = place[:, 3:, 3:] = turn @ state.frame_rotation[observations.frame[c]]
    lever = np.einsum("vij,vj->vi", place[:, :3, :3], state.board_mm[observations.cameras[c].board])
    each = np.broadcast_to(target, mount.shape).copy()
    each[:, 3:, :3] = -skew(lever) @ turn
    return PoseJacobians(each, mount, place)


def rig_normal(observations: RigObservations, state: RigState, sigma_px: float = 0.0) -> NormalEquations:
    """Return the normal equations over the globals (`RigState.layout`) and the targets' poses.

    `sigma_px`, the standard deviation of a corner, sets residuals against the priors of cameras and shape; zero for no
    priors.
    """
    layout = state.layout(observations)
    count, poses = layout.count, len(observations.keys)
    gg, g = np.zeros((count, count)), np.zeros(count)
    gp, pp, p = np.zeros((poses, count, 6)), np.zeros((poses, 6, 6)), np.zeros((poses, 6))
    costs = np.zeros(poses)
    each: list[NormalEquations] = []
    for c, own in enumerate(observations.cameras):
        alone = state.of_camera(c, observations)
        n = normal_equations(own, alone, observations.weights[c])
        each.append(n)
        f = observations.frame[c]
        by = pose_jacobians(observations, state, c, alone.translation_mm)
        k, size = layout.cameras[c], alone.camera.parameters.size
        parts: list[tuple[slice, slice]] = [(k, slice(0, size))]
        if layout.shape.stop > layout.shape.start:
            parts.append((layout.shape, slice(size, None)))
        for there, here in parts:
            g[there] += n.g[here]
            for also, too in parts:
                gg[there, also] += n.gg[here, too]
        # Several views of a camera are of one pose only where targets have several boards.
        add = _add_repeated if observations.tied else _add
        for there, here in parts:
            add(gp[:, there], f, n.gp[:, here] @ by.target)
        by_target = np.swapaxes(by.target, -1, -2)
        add(pp, f, by_target @ n.pp @ by.target)
        add(p, f, (by_target @ n.p[..., None])[..., 0])
        add(costs, f, n.costs)
        everyone = np.arange(len(f))
        free = [] if layout.mounts[c] is None else [(layout.mounts[c], by.mount, everyone)]
        if by.place is not None:
            boards = [(b, run) for b, run in enumerate(layout.boards) if run is not None]
            free += [(run, by.place, np.flatnonzero(own.board == b)) for b, run in boards]
        for run, how, views in free:
            assert run is not None
            turned = np.swapaxes(how[views], -1, -2)
            moved = turned @ n.pp[views]
            for there, here in parts:
                gg[there, run] += (n.gp[views, here] @ how[views]).sum(axis=0)
                gg[run, there] = gg[there, run].T
            gg[run, run] += (moved @ how[views]).sum(axis=0)
            g[run] += (turned @ n.p[views, :, None]).sum(axis=0)[:, 0]
            add(gp[:, run], f[views], moved @ (by.target if by.target.ndim == 2 else by.target[views]))
        if len(free) > 1 and layout.mounts[c] is not None:
            m = layout.mounts[c]
            for run, how, views in free[1:]:
                gg[m, run] += (np.swapaxes(by.mount[views], -1, -2) @ n.pp[views] @ how[views]).sum(axis=0)
                gg[run, m] = gg[m, run].T
    released = None
    if observations.shape.kind == "released":
        released = layout.shape.start + observations.shape.basis.shape[-1]
    whole = replace(_joined(each), gg=gg, gp=gp, pp=pp, g=g, p=p, costs=costs, points_from=released)
    return with_rig_priors(whole, observations, state, sigma_px)


def _joined(each: Sequence[NormalEquations]) -> NormalEquations:
    """Return the first with what those of all cameras know of their corners and views."""
    residuals = tuple(own for normal in each for own in normal.residuals)
    return replace(each[0], residuals=residuals, products=tuple(own for normal in each for own in normal.products))


def with_rig_priors(
    normal: NormalEquations, observations: RigObservations, state: RigState, sigma_px: float
) -> NormalEquations:
    """Add what is known of cameras and shape without any corner, and what holds lenses near their own solutions."""
    layout = state.layout(observations)
    cameras = list(zip(layout.cameras, state.cameras, strict=True))
    normal = normal.with_priors(cameras, layout.shape, observations.shape.sigma, state.unknowns, sigma_px)
    for (where, camera), (near, information) in zip(cameras, observations.held, strict=False):
        normal = normal.with_quadratic(where, camera.parameters - near, information)
    for c, held in enumerate(observations.held_mounts):
        run = layout.mounts[c]
        if held is not None and run is not None:
            turned = log_so3(state.mount_rotation[c] @ held[0].rotation.T)
            off = np.concatenate([turned, state.mount_mm[c] - held[0].translation_mm])
            normal = normal.with_quadratic(run, off, held[1])
    return normal


def _add(total: FloatArray, row: IntArray, values: FloatArray) -> None:
    total[row] += values


def _add_repeated(total: FloatArray, row: IntArray, values: FloatArray) -> None:
    np.add.at(total, row, values)


def solve_rig(
    observations: RigObservations, start: RigState, sigma_px: float, tolerance: float = COST_TOLERANCE
) -> RigSolution:
    """Return the state of least weighted squares from `start`, and how the solver ended.

    `sigma_px` as for `rig_normal`; `tolerance` is the part of the cost that a step must promise to be taken.
    """
    layout = start.layout(observations)

    def linearise(state: RigState) -> Linearised:
        normal = rig_normal(observations, state, sigma_px)
        return Linearised(normal, normal)

    state, last, convergence = minimise(
        start, linearise, lambda state, step: state.moved(step, layout), tolerance=tolerance
    )
    return RigSolution(state, last.normal, convergence)


def refine_frames(observations: RigObservations, state: RigState) -> RigState:
    """Return the state with the pose of every target at its own minimum, all else as it is."""
    seen = replace(observations, shape=observations.shape.held(state.unknowns))
    held = replace(state, unknowns=np.zeros(0))

    def linearise(rotation: Mat3, translation_mm: Points) -> NormalEquations:
        return rig_normal(seen, replace(held, frame_rotation=rotation, frame_mm=translation_mm))

    rotation, translation_mm, _ = refine_each(state.frame_rotation, state.frame_mm, linearise)
    return replace(state, frame_rotation=rotation, frame_mm=translation_mm)
