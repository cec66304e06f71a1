"""Compare one reconstructed quantity with its measured value.

A check passes if |ours - measured| <= k sqrt(sigma_ours^2 + sigma_measured^2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.truth import MeasuredAngle, MeasuredDistance, MeasuredLength


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """The comparison of a reconstructed with a measured or declared quantity.

    Attributes
    ----------
    name : "baseline", "angle plane1-plane2", "distance plane1.centre to plane2", "pose type planar", "level".
    kind : "baseline", "angle", "distance", or for a declaration "pose type", "level", "board size", "layout".
    unit : "mm" or "deg", of all values.
    measured, measured_sigma, how : the measured value, its standard deviation, and the method of measurement.
    ours, our_sigma : the reconstructed value and its predicted standard deviation.
    difference : ours - measured.
    combined_sigma : root of the sum of both variances.
    k : |difference| / combined_sigma.
    limit_k : the largest k that passes.
    passed : the verdict.
    count : number of points that the reconstructed value is based on.
    """

    name: str
    kind: str
    unit: str
    measured: float
    measured_sigma: float
    how: str
    ours: float
    our_sigma: float
    difference: float
    combined_sigma: float
    k: float
    limit_k: float
    passed: bool
    count: int


def compare(
    name: str,
    kind: str,
    unit: str,
    known: tuple[float, float, str],
    ours: tuple[float, float],
    coverage: float,
    count: int,
    *,
    combined_sigma: float | None = None,
) -> Check:
    """Return the check of `ours` (value, sigma) against `known` (value, sigma, how).

    A sigma of `ours` that is NaN (not predicted) counts as zero, which makes the check stricter. Pass `combined_sigma`,
    the standard deviation of the difference, if the two values are not independent.
    """
    value, sigma, how = known
    our_sigma = ours[1] if np.isfinite(ours[1]) else 0.0
    difference = ours[0] - value
    combined = float(np.hypot(sigma, our_sigma)) if combined_sigma is None else combined_sigma
    k = abs(difference) / combined
    return Check(
        name=name,
        kind=kind,
        unit=unit,
        measured=value,
        measured_sigma=sigma,
        how=how,
        ours=float(ours[0]),
        our_sigma=float(ours[1]),
        difference=float(difference),
        combined_sigma=combined,
        k=float(k),
        limit_k=coverage,
        passed=bool(k <= coverage),
        count=count,
    )


def compare_baseline(name: str, known: MeasuredLength, ours: tuple[float, float], coverage: float, count: int) -> Check:
    """Return the check of a baseline (value and sigma, mm) against its measured value."""
    return compare(name, "baseline", "mm", (known.value_mm, known.sigma_mm, known.how), ours, coverage, count)


def compare_angle(known: MeasuredAngle, ours: tuple[float, float], coverage: float, count: int) -> Check:
    """Return the check of an angle between boards (value and sigma, deg) against its measured value."""
    return compare(known.name, "angle", "deg", (known.value_deg, known.sigma_deg, known.how), ours, coverage, count)


def compare_distance(known: MeasuredDistance, ours: tuple[float, float], coverage: float, count: int) -> Check:
    """Return the check of a distance on boards (value and sigma, mm) against its measured value."""
    return compare(known.name, "distance", "mm", (known.value_mm, known.sigma_mm, known.how), ours, coverage, count)
