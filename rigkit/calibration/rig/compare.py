"""Two calibrations of a rig: have its cameras moved against each other?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import log_so3

__all__ = ["MountDifference", "RigDifference", "compare_mounts"]

SAME_CHANCE = 0.01
"""Mounts this unlikely to be one and the same rig's are another rig's, or a rig's that was bent."""


@dataclass(frozen=True, slots=True)
class MountDifference:
    """How far one camera sits from where the other calibration has it: degrees, mm, and the chance of as much if it did
    not move; None where a rig does not say how sure it is."""

    name: str
    rotation_deg: float
    shift_mm: float
    chance: float | None


@dataclass(frozen=True, slots=True)
class RigDifference:
    """Of every camera but the first, and the chance of as much in all of them if nothing moved."""

    mounts: tuple[MountDifference, ...]
    chance: float | None

    @property
    def same(self) -> bool | None:
        return None if self.chance is None else self.chance >= SAME_CHANCE


def compare_mounts(
    names: Sequence[str],
    a: Sequence[Rigid3],
    b: Sequence[Rigid3],
    covariance_a: FloatArray | None,
    covariance_b: FloatArray | None,
) -> RigDifference:
    """Compare cam_from_rig of n cameras, the first the identity in both; of one camera alone nothing can differ.

    Parameters
    ----------
    covariance_a, covariance_b : (6 (n - 1), 6 (n - 1)) of the mounts of all but the first: left perturbations, rad and
        mm; None where that is not known. An error of the squares' size is the same in both where the boards are: it is
        not among them.
    """
    both = None if covariance_a is None or covariance_b is None else covariance_a + covariance_b
    off = np.concatenate([np.zeros(0), *(_off(first, second) for first, second in zip(a[1:], b[1:], strict=True))])
    mounts = []
    for k, name in enumerate(names[1:]):
        own = slice(6 * k, 6 * k + 6)
        angle, shift = np.degrees(np.linalg.norm(off[own][:3])), np.linalg.norm(off[own][3:])
        chance = None if both is None else _chance(off[own], both[own, own])
        mounts.append(MountDifference(name, float(angle), float(shift), chance))
    return RigDifference(tuple(mounts), None if both is None else _chance(off, both))


def _off(first: Rigid3, second: Rigid3) -> FloatArray:
    """Return the left perturbation that takes the second to the first."""
    turn = log_so3(first.rotation @ second.rotation.T)
    return np.concatenate([turn, first.translation_mm - second.translation_mm])


def _chance(off: FloatArray, covariance: FloatArray) -> float:
    """Return the probability of a chi-square, of as many degrees of freedom as `off` has numbers (even), this large."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    scaled = np.linalg.pinv(covariance * scale[:, None] * scale, hermitian=True)
    half = 0.5 * float((off * scale) @ scaled @ (off * scale))
    term = total = 1.0
    for k in range(1, len(off) // 2):
        term *= half / k
        total += term
    return float(min(exp(-half) * total, 1.0)) if half < 700.0 else 0.0
