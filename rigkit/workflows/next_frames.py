"""The frames that would improve a rig most, for what it is to be used for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.rig.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.candidates import Reach
from rigkit.planning.goal import Goal
from rigkit.planning.plan import Plan
from rigkit.planning.rig_goal import rig_goal
from rigkit.validation.certificate.contracts import Task
from rigkit.validation.sentinel.evidence import Watched
from rigkit.validation.sentinel.frames import Frames
from rigkit.workflows.next_views import length_goal


def next_frames(
    watched: Watched, boards: Sequence[Board], count: int, *, length: Task | None = None, reach: Reach | None = None
) -> Plan:
    """Return the frames that would improve a rig most: of every camera at one moment, of one board. Boards are taken
    for flat, and images to disagree as those of the calibration do.

    Raises InputError: no board, no frame asked for, or a length of a rig that is not a pair; DegenerateError: no board
    fits into any image at the distances allowed, or the length is nowhere in view.
    """
    if not boards or count < 1:
        raise InputError("plan: at least one board and one picture are needed")
    reach = reach or Reach()
    frames = Frames.of(watched, boards, reach)
    if length is None:
        away = float(np.median(np.linalg.norm(frames.translation_mm, axis=-1)))
        goal = rig_goal(watched.cameras, watched.cam_from_rig, away, reach.field_deg)
    elif len(watched.cameras) != 2:
        raise InputError("plan: --length is for one camera or a rig of two; leave it away")
    else:
        (goal,) = length_goals(watched.cameras, watched.cam_from_rig, length)
    return frames.plan(watched, boards, goal, count)


def length_goals(cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3], length: Task) -> list[Goal]:
    """Return the errors of a length that the first camera sees with each of the others, where two see it, or alone;
    the weights are on what `Layout.of_cameras` has.

    Raises DegenerateError where the length is nowhere in view.
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
        # The first mount is the rig's frame.
        first = len(pair.weight) - 12
        kept = np.r_[:first, first + 6 : first + 12]
        own = replace(pair, weight=pair.weight[np.ix_(kept, kept)])
        goals.append(own.among(np.r_[layout.cameras[0], layout.cameras[k], layout.mount(k)], layout.count))
    if last is not None and not goals:
        raise last
    return goals
