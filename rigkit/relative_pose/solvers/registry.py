"""Solvers of the epipolar geometry by pose type."""

from __future__ import annotations

from rigkit.core.errors import InputError
from rigkit.relative_pose.solvers.estimate import FundamentalSolver
from rigkit.relative_pose.solvers.family import FORWARD, FORWARD_WITH_ROLL, FREE_TRANSLATION, STANDARD
from rigkit.relative_pose.solvers.general import GeneralSolver
from rigkit.relative_pose.solvers.planar import PlanarSolver
from rigkit.relative_pose.solvers.standard import RowsSolver

SOLVERS: dict[str, FundamentalSolver] = {
    "general": GeneralSolver(),
    "planar": PlanarSolver(),
    "standard": STANDARD,
    "forward": FORWARD,
    "translation": FREE_TRANSLATION,
    "standard-rows": RowsSolver(),
    "forward-roll": FORWARD_WITH_ROLL,
}
"""Solvers of the pose types and of other motions: "translation" has no rotation; "standard-rows" estimates the relation
between the images' rows that standard stereo assumes to be known, "forward-roll" the roll of forward motion."""


def fundamental_for(pose_type: str, *, motion: str | None = None) -> FundamentalSolver:
    """Return the solver for a pose type.

    `motion` overrides the choice: motion="planar" uses the planar solver for standard and forward pairs too, as the
    paper does. Raises InputError for an unknown name; "auto" has to be decided first (`pose_type_evidence`).

    >>> fundamental_for("planar").degrees_of_freedom
    2
    """
    name = str(motion or pose_type)
    if name not in SOLVERS:
        hint = "; decide it with pose_type_evidence first" if name == "auto" else ""
        raise InputError(f"no epipolar solver is called '{name}'; known: {', '.join(sorted(SOLVERS))}{hint}")
    return SOLVERS[name]
