"""The boards' shape in a rig, common to all cameras, with initial values from the cameras alone, and the error that it
leaves, which is common to all frames and so not in their scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.solving.solver import rig_normal
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.calibration.solving.evidence import MIN_SIZE, chance_limit
from rigkit.calibration.solving.shape import SHAPES, ShapeModel, released_groups, shape_model, warp_groups
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import FloatArray, Points

STEP_DAMPING = 1e-12
"""Damping of the step: undetermined unknowns are not changed."""


def common_shape(observations: Observations, single: Sequence[Calibration]) -> tuple[ShapeModel, FloatArray]:
    """Return the shape model of all cameras' boards, and initial unknowns from the mean shape over the cameras.

    It is the richest kind that a camera alone has chosen: a board that is bent for one camera is bent. The widths of
    the priors are those of the shapes that the cameras alone have found.
    """
    kind = max((b.kind for alone in single for b in alone.boards), key=SHAPES.index)
    shape = shape_model(kind, observations)
    if not shape.count:
        return shape, np.zeros(0)
    unknowns = _nearest(shape, _average(observations, single))
    return replace(shape, sigma=_found(observations, shape, unknowns)), unknowns


def _average(observations: Observations, single: Sequence[Calibration]) -> Points:
    """Return the mean corners of all boards over the cameras that saw them."""
    found: dict[str, list[Points]] = {}
    for shape in (shape for alone in single for shape in alone.boards):
        found.setdefault(shape.board_id, []).append(shape.points_mm)
    points = observations.table()
    for board, first in zip(observations.boards, observations.first_row, strict=False):
        if board.board_id in found:
            points[first : first + board.corner_count] = np.mean(found[board.board_id], axis=0)
    return points


def _nearest(shape: ShapeModel, points: Points) -> FloatArray:
    """Return the unknowns that fit `points`: the warp by least squares, then the rest by released corners."""
    off = points - shape.flat
    count = shape.basis.shape[-1]
    warp = np.linalg.lstsq(shape.basis.reshape(-1, count), off.reshape(-1), rcond=None)[0]
    return np.concatenate([warp, (off - shape.basis @ warp)[shape.released].ravel()])


def _found(observations: Observations, shape: ShapeModel, unknowns: FloatArray) -> FloatArray:
    """Return the prior standard deviation of each unknown: the rms of those of one kind on one board."""
    sizes = shape.sigma.copy()
    groups = [*warp_groups(observations)]
    if shape.kind == "released":
        groups += released_groups(observations, shape.basis.shape[-1])
    for group in groups:
        found = float(np.sqrt((unknowns[group] ** 2).mean()))
        sizes[group] = max(found, MIN_SIZE * float(sizes[group].max()))
    return sizes


def shape_error(observations: RigObservations, state: RigState, sigma_px: float) -> FloatArray:
    """Return the change of the globals except the shape, (G,), by the richest board shape that is significant against
    the one before it; zero if none is. One step of the solver with a richer shape gives it, and it is taken as the
    error of cameras and mounts.

    `sigma_px` is the standard deviation of a corner, overdispersion of the frames included.
    """
    count = state.layout(observations).shape.start
    found = np.zeros(count)
    if not sigma_px > 0.0:
        return found
    # A board's views in all cameras count together for whether its shape is determined.
    boards = np.concatenate([own.board for own in observations.cameras])
    everything = replace(observations.cameras[0], board=boards)
    for kind in SHAPES[SHAPES.index(observations.shape.kind) + 1 :]:
        shape, unknowns = observations.shape.richer(kind, everything, state.unknowns)
        normal = rig_normal(replace(observations, shape=shape), replace(state, unknowns=unknowns), sigma_px)
        step = normal.step(STEP_DAMPING)
        more = shape.count - observations.shape.count
        if step is None or step.predicted < sigma_px**2 * chance_limit(more):
            break
        found = step.globals[:count]
    return found
