"""The frames that would improve a rig most, for what it is to be used for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.planning.candidates import Reach
from rigkit.planning.goal import Goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import Plan, choose_views, covariance_of
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
    frames, sigma = Frames.of(watched, boards, reach), watched.fresh_sigma_px
    if length is None:
        away = float(np.median(np.linalg.norm(frames.translation_mm, axis=-1)))
        goal = rig_goal(watched.cameras, watched.cam_from_rig, away, reach.field_deg)
    else:
        goal = _length_goal(watched, length)
    inverse = covariance_of(watched.covariance)
    taken, errors = choose_views(inverse, frames.information / sigma**2, goal, count)
    before = float(goal.error(watched.covariance))
    known = Knowledge(watched.cameras[0], inverse, CornerError(sigma))
    return Plan(known, goal, before, frames.proposals(watched, boards, taken, errors))


def _length_goal(watched: Watched, length: Task) -> Goal:
    """Return the error of a length that both cameras of a pair see."""
    if len(watched.cameras) != 2:
        raise InputError("plan: --length is for one camera or a rig of two; leave it away")
    goal = length_goal(watched.cameras, watched.cam_from_rig, length)
    # The first mount is the rig's frame.
    first = sum(camera.parameters.size for camera in watched.cameras)
    kept = np.r_[:first, first + 6 : first + 12]
    return Goal(goal.weight[np.ix_(kept, kept)], goal.unit, goal.what)
