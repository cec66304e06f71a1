"""Which pictures to check a camera with: those that would tell changes of its lens best.

With P = (C^-1 + A)^-1, C the covariance of the calibration and A what fresh views say, changes a of a cause D scatter
by N^-1, N = D^T (C + A^-1)^-1 D = D^T (C^-1 - C^-1 P C^-1) D. Views that make this small for every cause are not those
that improve the calibration most: what a lens needs known least may be what changes.

Reference: A. C. Atkinson, A. N. Donev, R. D. Tobias, "Optimum Experimental Designs, with SAS" (2007), section 10.3
(the designs for parts of the parameters).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.planning.candidates import Reach
from rigkit.planning.information import CornerError, HeldBoards, Knowledge
from rigkit.planning.plan import Plan, Proposal, covariance_of, plan_views
from rigkit.validation.sentinel.causes import Cause, causes_of, lens_goals
from rigkit.validation.sentinel.evidence import FreshEvidence, Watched
from rigkit.validation.sentinel.judge import ALARM_CHANCE
from rigkit.validation.sentinel.power import LENS_KINDS, Power, powers_of
from rigkit.validation.sentinel.whitened import NULL_RANK


@dataclass(frozen=True, eq=False, slots=True)
class ChangeAim:
    """How surely the size of a change is told.

    Attributes
    ----------
    shown : for each cause C^-1 D (T, m), D in px over the image, and D^T C^-1 D (m, m).
    """

    shown: tuple[tuple[FloatArray, FloatArray], ...]
    unit: str = "px"
    what: str = "standard error of a change of focus, principal point or distortion, over the image"

    @classmethod
    def of(cls, watched: Watched, causes: Sequence[Cause], inverse: FloatArray) -> ChangeAim:
        """Return the aim for causes of one camera whose covariance has the `inverse`."""
        (goal,) = lens_goals(watched)
        shown = []
        for cause in causes:
            size, axes = np.linalg.eigh(cause.directions.T @ goal.weight @ cause.directions)
            seen = size > NULL_RANK * size[-1]
            by_px = cause.directions @ (axes[:, seen] / np.sqrt(size[seen]))
            shown.append((inverse @ by_px, by_px.T @ inverse @ by_px))
        return cls(tuple(shown))

    def error(self, covariance: FloatArray) -> FloatArray:
        """Return the root of the causes' variances together, each the geometric mean over its directions, so that none
        is told at the cost of all others; huge where there is one of which the views say nothing."""
        variance = np.zeros(covariance.shape[:-2])
        for by_theta, whole in self.shown:
            told = np.linalg.eigvalsh(whole - by_theta.T @ covariance @ by_theta)
            told = np.maximum(told, NULL_RANK * np.trace(whole))
            variance = variance + np.exp(-np.log(told).mean(axis=-1))
        return np.asarray(np.sqrt(variance))


def views_that_tell(
    watched: Watched, boards: Sequence[Board], count: int, reach: Reach | None = None
) -> tuple[Plan, tuple[Power, ...]]:
    """Return the pictures to check a camera with, and how well they would find what changed.

    Raises InputError for a rig, and as `plan_views`.
    """
    if len(watched.cameras) > 1:
        raise InputError("plan: pictures to check with are planned for one camera; give its own calibration")
    causes = [cause for cause in causes_of(watched) if cause.kind in LENS_KINDS]
    sigma = watched.fresh_sigma_px
    knowledge = Knowledge(watched.cameras[0], covariance_of(watched.covariance), CornerError(sigma))
    aim = ChangeAim.of(watched, causes, knowledge.information)
    # So few are taken that none is to be less than the best.
    plan = plan_views(knowledge, boards, aim, count, reach=reach, nearly=0.0)
    plan = replace(plan, error=float("inf"))  # Without any picture.
    fresh = np.array([_told(knowledge, view) for view in plan.views])
    evidence = FreshEvidence(
        information=sigma**2 * fresh,
        score=np.zeros(fresh.shape[:2]),
        variance_px2=sigma**2,
        rms_px=float(np.sqrt(2.0) * sigma),
        expected_px=float(np.sqrt(2.0) * sigma),
        corners=sum(view.board.corner_count for view in plan.views),
        left_out=0,
        overdispersion=watched.overdispersion,
        freedom=watched.freedom,
    )
    return plan, powers_of(watched, evidence, causes_of(watched), ALARM_CHANCE)


def _told(knowledge: Knowledge, view: Proposal) -> FloatArray:
    """Return what a view adds to what is known, (T, T)."""
    pose, points = view.cam_from_board, view.board.points()
    held = HeldBoards(points, pose.rotation[None], pose.translation_mm[None], view.board.exists()[None])
    return np.asarray(knowledge.of_views(held)[0])
