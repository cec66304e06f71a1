"""Solvers of the epipolar geometry by pose type."""

from __future__ import annotations

from rigkit.core.errors import InputError
from rigkit.relative_pose.solvers.estimate import FundamentalSolver
from rigkit.relative_pose.solvers.fixed import FixedSolver
from rigkit.relative_pose.solvers.forward import ForwardRollSolver
from rigkit.relative_pose.solvers.general import GeneralSolver
from rigkit.relative_pose.solvers.planar import PlanarSolver
from rigkit.relative_pose.solvers.standard import RowsSolver
from rigkit.relative_pose.solvers.translation import TranslationSolver

SOLVERS: dict[str, FundamentalSolver] = {
    "general": GeneralSolver(),
    "planar": PlanarSolver(),
    "standard": FixedSolver((1.0, 0.0, 0.0)),
    "forward": FixedSolver((0.0, 0.0, 1.0)),
    "translation": TranslationSolver(),
    "standard-rows": RowsSolver(),
    "forward-roll": ForwardRollSolver(),
}
"""Pose types, and motions that may override them: "translation" for those without rotation, "standard-rows" for
standard stereo of perspective views, "forward-roll" for forward motion, each with what the fixed solver takes as known
left to be estimated."""


def fundamental_for(pose_type: str, *, motion: str | None = None) -> FundamentalSolver:
    """Return the solver for a pose type.

    `motion` overrides the solver, not the pose type: motion="planar" runs the planar solver on standard and forward
    pairs too, as the paper does, "standard-rows" and "forward-roll" their own constrained solvers. Raises InputError
    for an unknown name; "auto" has to be decided first (select).

    >>> fundamental_for("planar").degrees_of_freedom
    2
    """
    name = str(motion or pose_type)
    if name not in SOLVERS:
        hint = "; decide it with pose_type_evidence first" if name == "auto" else ""
        raise InputError(f"no epipolar solver is called '{name}'; known: {', '.join(sorted(SOLVERS))}{hint}")
    return SOLVERS[name]
