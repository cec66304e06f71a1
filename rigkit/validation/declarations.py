"""What was declared of a pair against what its corners show: the pose type and the level, each a check of its own.

A declaration enters the reconstruction as a prior. One that does not hold bends the result without any trace in the
measured lengths and angles, so it has to be judged by itself.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.posetype import PoseType
from rigkit.reconstruction.geometry import PoseTypeDecision
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.relative_pose.refinement.select import CONTRADICTION_P, TypeEvidence
from rigkit.validation.check import Check

__all__ = ["DECLARED", "declaration_checks"]

DECLARED = ("pose type", "level")
"""Kinds of checks that are about a declaration, not about a measured quantity."""
MAX_TOLD_SIGMAS = 38.0
"""A chance below the smallest number there is is told as this many standard deviations."""


def declaration_checks(reconstruction: Reconstruction) -> tuple[tuple[Check, ...], tuple[str, ...]]:
    """Return the checks of the declared pose type and level, and what could not be checked, in words.

    Nothing is returned where nothing was declared: the general type, or "auto".
    """
    if reconstruction.geometry is None:
        return (), ()
    decision, count = reconstruction.geometry.decision, len(reconstruction.cloud)
    if decision.evidence is None or decision.declared in (PoseType.AUTO, PoseType.GENERAL):
        return (), ()
    checks, unchecked = [], []
    # Two cameras on one level keep the vertical and the height: what the planar type says, and the others imply.
    for kind, name, pose_type in (
        ("pose type", f"pose type {decision.declared}", decision.declared),
        ("level", "level", PoseType.PLANAR),
    ):
        found = decision.evidence.of(pose_type)
        if found is None:
            unchecked.append(f"{name}: no pose of that type puts the points in front of both cameras")
        else:
            checks.append(_check(kind, name, found, decision, count))
    return tuple(checks), tuple(unchecked)


def _check(kind: str, name: str, found: TypeEvidence, decision: PoseTypeDecision, count: int) -> Check:
    """Return a declaration as a check: no deviation was declared, its chance gives the standard deviations it is off.

    Several angles are judged at once: their combined sigma is that of the largest one which has the same chance.
    """
    from scipy.special import ndtri

    assert decision.evidence is not None
    level_deg, ours = (float(np.rad2deg(v)) for v in (decision.evidence.level_sigma_rad, found.deviation_rad))
    k = min(float(-ndtri(0.5 * max(found.p_value, 1e-320))), MAX_TOLD_SIGMAS)
    limit = float(-ndtri(0.5 * CONTRADICTION_P))
    combined = ours / k if k > 1.0 else max(ours, level_deg)
    return Check(
        name=name,
        kind=kind,
        unit="deg",
        measured=0.0,
        measured_sigma=level_deg,
        how="declared",
        ours=ours,
        our_sigma=float("nan"),
        difference=ours,
        combined_sigma=combined,
        k=k,
        limit_k=limit,
        passed=found.p_value >= CONTRADICTION_P,
        count=count,
    )
