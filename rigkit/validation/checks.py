"""Validate a reconstruction against measured baselines, angles and distances.

A check passes if |ours - measured| <= k sqrt(sigma_ours^2 + sigma_measured^2). k = 2 is the usual coverage factor of a
stated measurement (about 95 %, JCGM 100 "GUM", section 6). If all sigmas are right, a correct result fails one check in
twenty.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from rigkit.core.arrays import FloatArray, without_nan
from rigkit.core.choices import Planes
from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.core.truth import PairTruth
from rigkit.reconstruction.calibration_shifts import CalibrationShifts
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.boards import BoardResult
from rigkit.validation.check import Check, compare_angle, compare_baseline, compare_distance
from rigkit.validation.declarations import DECLARED, contradicted_boards, declaration_checks
from rigkit.validation.fitted_planes import AngleResult, FittedPlanes, normal_errors_against
from rigkit.validation.measure import Measured, measure
from rigkit.validation.planes import NormalErrors

COVERAGE = 2.0
ANGLE_ERRORS = ("error_deg", "coplanar_error_deg", "lattice_error_deg")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ValidationReport:
    """The validation of one pair with one affine estimator.

    Raises InputError if it has no check of a measured quantity.

    Attributes
    ----------
    pair_id, pose_type, affine_method : of the validated reconstruction.
    checks : every measured quantity that could be compared.
    unchecked : measured quantities that could not be compared, and why; the report does not pass with any.
    boards : plane, normal errors and lattice of each board.
    angles : between every two boards.
    baseline_mm, baseline_sigma_mm, sampson_rms_px, count : of the reconstruction.
    notes : the reconstruction's notes, and boards with outliers.
    planes : which kind of planes the checks of angles, normals and baseline use.
    checked_normals : normals of the boards, unless they are those of planes through the points.
    coplanar_normal_errors, lattice_normal_errors : errors of the estimated normals against the planes that were fitted
        to both images, by board.
    """

    pair_id: str
    pose_type: str
    affine_method: str
    checks: tuple[Check, ...]
    unchecked: tuple[str, ...]
    boards: tuple[BoardResult, ...]
    angles: tuple[AngleResult, ...]
    baseline_mm: float
    baseline_sigma_mm: float
    sampson_rms_px: float
    count: int
    notes: tuple[str, ...] = ()
    planes: Planes = "free"
    checked_normals: Mapping[str, FloatArray] = field(default_factory=dict)
    coplanar_normal_errors: Mapping[str, NormalErrors] = field(default_factory=dict)
    lattice_normal_errors: Mapping[str, NormalErrors] = field(default_factory=dict)

    __repr__ = brief

    def __post_init__(self) -> None:
        if all(check.kind in DECLARED for check in self.checks):
            why = f" ({'; '.join(self.unchecked)})" if self.unchecked else ""
            raise InputError(
                f"pair '{self.pair_id}': nothing measured can be checked{why}; add a baseline or angles under "
                "[pairs.truth]"
            )

    @property
    def passed(self) -> bool:
        """Whether every measured quantity was checked, and every check passed."""
        return not self.unchecked and all(check.passed for check in self.checks)

    def check(self, name: str) -> Check:
        """Return the check of that name; raises InputError if there is none."""
        for check in self.checks:
            if check.name == name:
                return check
        raise InputError(f"no check is called '{name}'; known: {', '.join(c.name for c in self.checks)}")

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists; NaN becomes None."""
        out: dict[str, Any] = {
            "schema": "rigkit.validation/1",
            "pair": self.pair_id,
            "pose_type": self.pose_type,
            "affine_method": self.affine_method,
            "passed": self.passed,
            "planes": self.planes,
            "points": self.count,
            "baseline_mm": self.baseline_mm,
            "baseline_sigma_mm": self.baseline_sigma_mm,
            "sampson_rms_px": self.sampson_rms_px,
            "checks": [asdict(check) for check in self.checks],
            "unchecked": list(self.unchecked),
            "angles": [asdict(angle) | {name: getattr(angle, name) for name in ANGLE_ERRORS} for angle in self.angles],
            "boards": [self._board_dict(board) for board in self.boards],
            "notes": list(self.notes),
        }
        cleaned: dict[str, Any] = without_nan(out)
        return cleaned

    def _board_dict(self, result: BoardResult) -> dict[str, Any]:
        plane, board_id = result.plane, result.board.board_id
        return {
            "board": board_id,
            "points": plane.count,
            "normal": plane.normal.tolist(),
            "offset_mm": plane.offset_mm,
            "normal_sigma_deg": float(np.rad2deg(plane.sigma_rad)),
            "flatness_rms_mm": plane.rms_mm,
            "flatness_peak_mm": plane.peak_mm,
            "normal_errors": asdict(result.normal_errors),
            "coplanar_normal_errors": _normal_errors_dict(self.coplanar_normal_errors.get(board_id)),
            "lattice_normal_errors": _normal_errors_dict(self.lattice_normal_errors.get(board_id)),
            "square_x_ratio": result.square_x_ratio,
            "square_y_ratio": result.square_y_ratio,
            "skew_deg": result.skew_deg,
            "right_handed": result.right_handed,
        }

    def to_json(self) -> str:
        """Return `to_dict()` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False)


def validate(
    reconstruction: Reconstruction,
    truth: PairTruth | None,
    *,
    shifts: CalibrationShifts | None = None,
    fitted: FittedPlanes | None = None,
    coverage: float = COVERAGE,
    weighted: bool = True,
) -> ValidationReport:
    """Validate a reconstruction against measured truth.

    Raises InputError if nothing was measured, or nothing of a reconstructed board; DegenerateError if a board has too
    few points for a plane.

    Parameters
    ----------
    reconstruction : of one pair.
    truth : measurements of that pair; None raises InputError.
    shifts : from `calibration_shifts`: adds the calibrations' uncertainty to every sigma; None: exact intrinsics.
    fitted : planes fitted to both images, to compare with those of the points, or to check instead of them.
    coverage : largest |difference| / combined sigma that passes.
    weighted : fit planes with the points' covariances; else by unweighted principal component analysis.
    """
    if truth is None:
        raise InputError("validate: nothing was measured of this pair, so nothing can be checked; give its PairTruth")
    measured = measure(reconstruction, shifts, weighted=weighted)
    return _report(reconstruction, measured, truth, shifts, fitted or FittedPlanes(), coverage)


def validate_each(
    reconstructions: Sequence[Reconstruction],
    truth: PairTruth,
    shifts: Sequence[CalibrationShifts | None],
    fitted: FittedPlanes | None = None,
    layout: Mapping[str, str] | None = None,
) -> tuple[ValidationReport, ...]:
    """Validate reconstructions of one pair by several estimators, each with its shifts.

    Estimators that kept the same corners have the same points, whose planes are fitted once. `layout` gives the
    declared side of boards.
    """
    known: list[tuple[Reconstruction, CalibrationShifts | None, Measured]] = []
    reports = []
    for reconstruction, moved in zip(reconstructions, shifts, strict=True):
        measured = next((m for r, s, m in known if s is moved and r.same_points(reconstruction)), None)
        if measured is None:
            measured = measure(reconstruction, moved)
            known.append((reconstruction, moved, measured))
        own = measured.with_normals(reconstruction)
        reports.append(_report(reconstruction, own, truth, moved, fitted or FittedPlanes(), COVERAGE, layout))
    return tuple(reports)


def _report(
    reconstruction: Reconstruction,
    measured: Measured,
    truth: PairTruth,
    shifts: CalibrationShifts | None,
    fitted: FittedPlanes,
    coverage: float,
    layout: Mapping[str, str] | None = None,
) -> ValidationReport:
    baseline = _baseline(reconstruction, shifts, fitted)
    cloud = reconstruction.cloud
    angles = {frozenset(two): measured.angle_deg(*two) for two in combinations(measured.boards, 2)}
    checks: list[Check] = []
    if truth.baseline is not None:
        checks.append(compare_baseline("baseline", truth.baseline, baseline, coverage, len(cloud)))
    of_boards, unchecked = _checks_of_boards(measured, truth, angles, fitted, coverage)
    held, undeclared = declaration_checks(reconstruction, shifts)
    checks += [*of_boards, *held, *contradicted_boards(measured.boards, layout or {})]
    unchecked += undeclared
    against = normal_errors_against(reconstruction, fitted.constrained)
    stated = {frozenset((angle.a, angle.b)): angle.value_deg for angle in truth.angles}
    return ValidationReport(
        pair_id=reconstruction.pair_id,
        pose_type=str(reconstruction.pose_type),
        affine_method=reconstruction.affine_method,
        checks=tuple(checks),
        unchecked=tuple(unchecked),
        boards=tuple(replace(b, normal_errors=against.get(n, b.normal_errors)) for n, b in measured.boards.items()),
        angles=tuple(
            fitted.angle(a, b, angles[frozenset((a, b))], stated.get(frozenset((a, b))))
            for a, b in combinations(measured.boards, 2)
        ),
        baseline_mm=baseline[0],
        baseline_sigma_mm=baseline[1],
        sampson_rms_px=reconstruction.sampson_rms_px,
        count=len(cloud),
        notes=(*reconstruction.notes, *_outlier_notes(measured.boards.values())),
        planes=fitted.planes,
        checked_normals=fitted.checked_normals(),
        coplanar_normal_errors=normal_errors_against(reconstruction, fitted.coplanar),
        lattice_normal_errors=normal_errors_against(reconstruction, fitted.lattice),
    )


def _checks_of_boards(
    measured: Measured,
    truth: PairTruth,
    angles: Mapping[frozenset[str], tuple[float, float]],
    fitted: FittedPlanes,
    coverage: float,
) -> tuple[list[Check], list[str]]:
    """Return the checks of measured angles and distances, and which quantities could not be checked, and why."""
    checks: list[Check] = []
    unchecked: list[str] = []
    for angle in truth.angles:
        both = (angle.a, angle.b)
        if measured.absent(*both):
            unchecked.append(f"{angle.name}: {measured.absent(*both)}")
            continue
        checked = fitted.checked_angle(*both, angles[frozenset(both)])
        if checked is None:
            unchecked.append(f"{angle.name}: too few corners in both images for {fitted.planes} planes")
            continue
        checks.append(compare_angle(angle, checked, coverage, measured.count(*both)))
    for distance in truth.distances:
        ends = (distance.a.board_id, distance.b.board_id)
        if measured.absent(*ends):
            unchecked.append(f"{distance.name}: {measured.absent(*ends)}")
            continue
        checks.append(compare_distance(distance, measured.distance_mm(distance), coverage, measured.count(*ends)))
    return checks, unchecked


def _baseline(
    reconstruction: Reconstruction, shifts: CalibrationShifts | None, fitted: FittedPlanes
) -> tuple[float, float]:
    """Return the baseline to check and its sigma, including the calibrations' uncertainty, mm."""
    if fitted.constrained is not None:
        return fitted.constrained.baseline_mm()
    sigma = reconstruction.baseline_sigma_mm
    share = 0.0 if shifts is None else shifts.variance(lambda r: r.baseline_mm)
    return reconstruction.baseline_mm, float(np.hypot(sigma, np.sqrt(share)))


def _outlier_notes(boards: Iterable[BoardResult]) -> list[str]:
    return [
        f"board '{b.board.board_id}': {b.plane.gross} corners are outliers of its plane and were left out; "
        "was it occluded?"
        for b in boards
        if b.plane.gross
    ]


def _normal_errors_dict(errors: NormalErrors | None) -> dict[str, Any] | None:
    return None if errors is None else asdict(errors)
