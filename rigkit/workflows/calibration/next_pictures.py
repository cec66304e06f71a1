"""The views that improve a calibration most, and the frames that improve a rig most, for a given task."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.calibration.certainty.departures import with_own_noise
from rigkit.calibration.certainty.displaced import lens_modes, uncertain_camera
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.measurement_task import Quantity, Task
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.goal import Goal, projection_goal, rig_goal
from rigkit.planning.information import Knowledge
from rigkit.planning.plan import Plan, plan_views
from rigkit.validation.certificate.propagation import MAP_CELLS, gradients, measured_points
from rigkit.validation.monitoring.evidence import Monitored
from rigkit.validation.monitoring.frames import Frames

NEXT_VIEWS = 3
TASK_CELLS = (13, 10)
"""Columns and rows of the places at which a length is measured; a length that is in view at none of them is measured at
those of a certificate."""


def next_views(
    calibration: Calibration,
    boards: Sequence[Board],
    count: int = NEXT_VIEWS,
    *,
    length: Task | None = None,
    reach: Reach | None = None,
) -> Plan:
    """Return the plan of `count` views of `boards` that improve a calibration most, the first near the last one taken.

    The error before them is that of the calibration's covariance. Raises as `plan_views` and `goal_of`.
    """
    reach = reach or Reach()
    modes = lens_modes(calibration)
    known = Knowledge.of(with_own_noise(calibration)).with_model_inadequacy(modes)
    last = calibration.views[-1].cam_from_board
    goal, stated = goal_of(known.camera, reach, length), uncertain_camera(calibration, modes=modes).covariance
    return plan_views(known, boards, goal, count, reach=reach, last=last).stated(float(goal.error(stated)))


def next_frames(
    watched: Monitored, boards: Sequence[Board], count: int, *, length: Task | None = None, reach: Reach | None = None
) -> Plan:
    """Return the plan of `count` frames that improve a rig most. A frame has all cameras at one moment and one board.

    Boards count as flat, and residuals as large as those of the calibration. Raises InputError: no board, `count` below
    1, or a length for a rig that is not a pair; DegenerateError: no board fits into any image at the allowed distances,
    or the length is nowhere in view.
    """
    if not boards or count < 1:
        raise InputError("plan: at least one board and one picture are needed")
    reach = reach or Reach()
    frames = Frames.of(watched, boards, reach)
    if length is None:
        distance_mm = float(np.median(np.linalg.norm(frames.translation_mm, axis=-1)))
        goal = rig_goal(watched.cameras, watched.cam_from_rig, distance_mm, reach.field_deg)
    elif len(watched.cameras) != 2:
        raise InputError("plan: --length needs one camera or a rig of two; leave it out")
    else:
        (goal,) = length_goals(watched.cameras, watched.cam_from_rig, length)
    return frames.plan(watched, boards, goal, count)


def goal_of(camera: Camera, reach: Reach, task: Task | None) -> Goal:
    """Return the goal of a plan: a length at a distance, or without `task` the projection; raises as `length_goal`."""
    if task is None:
        return projection_goal(camera, reach.field_deg)
    return length_goal((camera,), (Rigid3.identity(),), task)


def length_goal(cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3], task: Task) -> Goal:
    """Return the goal of measuring a length with one camera or two, averaged over the image of the first, in whose
    frame they are.

    Its weight matrix is on the parameters of `Layout.of_cameras`. Raises InputError for a task of one camera that is no
    length, DegenerateError if the length is nowhere in view.
    """
    is_rig = len(cameras) > 1
    if not is_rig and task.quantity is not Quantity.LENGTH:
        raise InputError(f"plan: one camera measures no {task.quantity}; give a length at a distance")
    for cells in (TASK_CELLS, MAP_CELLS):
        rays, valid = cameras[0].unproject(grid_pixels(cameras[0].size_px, cells).reshape(-1, 2))
        found = gradients(cameras, cam_from_rig, *measured_points(rays[valid], task, is_rig))
        if found.seen.any():
            break
    if not found.seen.any():
        raise DegenerateError(
            f"nowhere is a length of {task.size_mm:g} mm at {task.distance_mm:g} mm in view; give a shorter "
            "length or another distance"
        )
    rows = found.by_calibration[found.seen].reshape(-1, found.by_calibration.shape[-1])
    what = f"standard error of a length of {task.size_mm:g} mm at {task.distance_mm:g} mm"
    return Goal(rows.T @ rows / len(rows), "mm", what)


def length_goals(cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3], length: Task) -> list[Goal]:
    """Return the goals of measuring a length with the first camera and each other one that sees it, or with one alone.

    The weight matrices are on the parameters of `Layout.of_cameras`. Raises DegenerateError if the length is nowhere in
    view.
    """
    if len(cameras) == 1:
        return [length_goal(cameras, cam_from_rig, length)]
    layout, goals, last = Layout.of_cameras(cameras), list[Goal](), None
    for k in range(1, len(cameras)):
        try:
            pair = length_goal((cameras[0], cameras[k]), (cam_from_rig[0], cam_from_rig[k]), length)
        except DegenerateError as error:
            last = error
            continue
        goals.append(pair.among(np.r_[layout.cameras[0], layout.cameras[k], layout.mount(k)], layout.count))
    if last is not None and not goals:
        raise DegenerateError(f"of no two cameras: {last}") from last
    return goals
