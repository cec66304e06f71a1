"""Greedy choice of views: the one that lowers the error of the goal most, then the next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.candidates import board_poses_in_view
from rigkit.planning.goal import Aim
from rigkit.planning.information import Knowledge

NEARLY = 0.03
"""Views whose gain and error are within this part of the best view's count as equally good: of these the one nearest
to the last pose is taken."""


@dataclass(frozen=True, eq=False, slots=True)
class Proposal:
    """A view to take: the pose of the board in front of `camera`, and the error of the goal after it. For a rig,
    `seen_by` are the names of the cameras that see it, `camera` first."""

    board: Board
    cam_from_board: Rigid3
    error: float
    camera: Camera
    seen_by: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """Views to take, in this order, with the error of the goal before them and the knowledge of the camera."""

    knowledge: Knowledge
    goal: Aim
    error: float
    views: tuple[Proposal, ...]

    @property
    def gain(self) -> float:
        """The relative reduction of the error by all views together."""
        return 1.0 - self.views[-1].error / self.error if self.views else 0.0

    def stated(self, error: float) -> Plan:
        """Return the plan with this error before the views, and those after them in proportion: a calibration states
        an error from the disagreement of its images, which differs from that predicted from its corners."""
        factor = error / self.error
        return replace(self, error=error, views=tuple(replace(v, error=factor * v.error) for v in self.views))


def covariance_of(information: FloatArray) -> FloatArray:
    """Return the inverses of information matrices (..., P, P), each scaled to a unit diagonal first: parameters differ
    by many orders of magnitude. Eigenvalues of singular matrices are raised to the rounding error."""
    scale = 1.0 / np.sqrt(np.einsum("...pp->...p", information))
    unit = information * scale[..., :, None] * scale[..., None, :]
    try:
        inverse = np.linalg.inv(unit)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(unit)
        values = np.maximum(values, unit.shape[-1] * np.finfo(np.float64).eps)
        inverse = (vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(inverse * scale[..., :, None] * scale[..., None, :])


def choose_views(
    information: FloatArray,
    views: FloatArray,
    goal: Aim,
    count: int,
    *,
    effort: Callable[[int], FloatArray] | None = None,
) -> tuple[list[int], list[float]]:
    """Return the indices of `count` of C views, in the order in which to take them, and the goal's error after each.

    Parameters
    ----------
    information : (P, P) before the views.
    views : (C, P, P) information of each view; each is taken once.
    effort : returns the distances (C,) of all views from view j, or for -1 from the last view taken before: of views
        nearly as good as the best (NEARLY) the nearest is taken. None: the best is taken.

    Raises DegenerateError for errors that are not finite.
    """
    left, taken, errors = np.arange(len(views)), [], []
    last = -1
    for _ in range(min(count, len(views))):
        before = float(goal.error(covariance_of(information)))
        after = goal.error(covariance_of(information + views[left]))
        best = float(after.min())
        if not (np.isfinite(before) and np.isfinite(best)):
            raise DegenerateError(
                "plan: no view can be evaluated: parameters or board of the calibration are implausible; "
                "calibrate again"
            )
        if effort is None:
            pick = int(np.argmin(after))
        else:
            # Rounding errors may make the error grow: then only the best view is good enough.
            gain = max(before - best, 0.0)
            good = np.flatnonzero(after <= best + NEARLY * min(gain, best))
            pick = int(good[np.argmin(effort(last)[left[good]])])
        last = int(left[pick])
        information = information + views[last]
        taken.append(last)
        errors.append(float(after[pick]))
        left = np.delete(left, pick)
    return taken, errors


def plan_views(
    knowledge: Knowledge,
    boards: Sequence[Board],
    goal: Aim,
    count: int,
    *,
    reach: Reach | None = None,
    last: Rigid3 | None = None,
) -> Plan:
    """Return the next `count` views to take of `boards`, one board a view, close to the pose `last` where several are
    nearly as good.

    Raises InputError without boards or for a `count` below 1, DegenerateError where no board fits into the image at the
    allowed distances.
    """
    if not boards or count < 1:
        raise InputError("plan: at least one board and one view are needed")
    held = [board_poses_in_view(knowledge.camera, board, reach or Reach()) for board in boards]
    views = np.concatenate([knowledge.of_views(h, b.board_id) for h, b in zip(held, boards, strict=True)])
    rotation = np.concatenate([h.rotation for h in held])
    middle = np.concatenate([h.rotation @ h.points_mm.mean(axis=0) + h.translation_mm for h in held])
    start = last or Rigid3(np.eye(3), np.array([0.0, 0.0, float(np.median(np.linalg.norm(middle, axis=-1)))]))

    def effort(view: int) -> FloatArray:
        rows = (rotation[view], middle[view]) if view >= 0 else (start.rotation, start.translation_mm)
        return _effort(rotation, middle, *rows)

    taken, errors = choose_views(knowledge.information, views, goal, count, effort=effort)
    owner = np.repeat(np.arange(len(boards)), [len(h) for h in held])
    translation = np.concatenate([h.translation_mm for h in held])
    proposals = [
        Proposal(boards[owner[i]], Rigid3(rotation[i], translation[i]), error, knowledge.camera)
        for i, error in zip(taken, errors, strict=True)
    ]
    return Plan(knowledge, goal, float(goal.error(covariance_of(knowledge.information))), tuple(proposals))


def _effort(rotation: FloatArray, middle: FloatArray, last_rotation: FloatArray, last_middle: FloatArray) -> FloatArray:
    """Return the distances of poses (C, ...) from the last: the sum of the angles of rotation and between the lines of
    sight, and of the logarithm of the ratio of the distances."""
    distance, last_distance = np.linalg.norm(middle, axis=-1), float(np.linalg.norm(last_middle))
    turned = np.einsum("cij,ij->c", rotation, last_rotation)
    seen = middle @ last_middle / (distance * last_distance)
    angle = np.arccos(np.clip(0.5 * (turned - 1.0), -1.0, 1.0)) + np.arccos(np.clip(seen, -1.0, 1.0))
    return np.asarray(angle + np.abs(np.log(distance / last_distance)))
