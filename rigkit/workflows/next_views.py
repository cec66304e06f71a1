"""The views that would improve a calibration most, for what it is to be used for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.calibration.displaced import uncertain_camera
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.candidates import Reach
from rigkit.planning.goal import Goal, projection_goal
from rigkit.planning.information import Knowledge
from rigkit.planning.plan import Plan, plan_views
from rigkit.validation.certificate.contracts import Instrument, Quantity, Task
from rigkit.validation.certificate.propagation import gradients, measured_points

NEXT_VIEWS = 3
TASK_CELLS = (13, 10)
"""Columns and rows of the places at which a length is measured."""


def next_views(
    calibration: Calibration,
    boards: Sequence[Board],
    count: int = NEXT_VIEWS,
    *,
    length: Task | None = None,
    reach: Reach | None = None,
) -> Plan:
    """Return the views of `boards` that would improve a calibration most, the first near the last one taken; the error
    before them is what the calibration states.

    Raises as `plan_views` and `goal_of`.
    """
    reach = reach or Reach()
    known = Knowledge.beyond_model(calibration)
    last = calibration.views[-1].cam_from_board
    goal, stated = goal_of(known.camera, reach, length), uncertain_camera(calibration).covariance
    return plan_views(known, boards, goal, count, reach=reach, last=last).stated(float(goal.error(stated)))


def goal_of(camera: Camera, reach: Reach, task: Task | None) -> Goal:
    """Return what the views are to improve: a length at a distance, or the whole projection.

    Raises InputError for a task that is no length, DegenerateError where the length is nowhere in view.
    """
    if task is None:
        return projection_goal(camera, reach.field_deg)
    if task.quantity is not Quantity.LENGTH:
        raise InputError(f"plan: one camera measures no {task.quantity}; give a length at a distance")
    return length_goal((camera,), (Rigid3.identity(),), task)


def length_goal(cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3], task: Task) -> Goal:
    """Return the error of a length seen by a camera, or by two, over the image of the first: its weight is on their
    parameters, and of two then on both mounts (rad, mm).

    Raises DegenerateError where the length is nowhere in view.
    """
    count = sum(camera.parameters.size for camera in cameras) + (12 if len(cameras) == 2 else 0)
    instrument = Instrument(
        names=tuple(f"{k}" for k in range(len(cameras))),
        cameras=tuple(cameras),
        cam_from_rig=tuple(cam_from_rig),
        covariance=np.zeros((count, count)),
        sigma_px=1.0,
    )
    rays, valid = cameras[0].unproject(grid_pixels(cameras[0].size_px, TASK_CELLS).reshape(-1, 2))
    _, by_calibration, _, seen = gradients(instrument, *measured_points(rays[valid], task, is_rig=instrument.is_rig))
    if not seen.any():
        raise DegenerateError(
            f"nowhere is a length of {task.size_mm:g} mm at {task.distance_mm:g} mm in view; give a shorter "
            "length or another distance"
        )
    rows = by_calibration[seen].reshape(-1, count)
    what = f"standard error of a length of {task.size_mm:g} mm at {task.distance_mm:g} mm"
    return Goal(rows.T @ rows / len(rows), "mm", what)
