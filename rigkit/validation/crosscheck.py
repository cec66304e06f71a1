"""Cross-check a reconstruction with independent methods that share only corners and calibration with it.

pycolmap: two-view geometry, triangulation and bundle adjustment, with the scale from the squares. Planar PnP: the pose
of every board in each view, without epipolar geometry. Other chain: the same pair in other pixels (raw or rectified).
A check fails if the difference is too large for its standard deviation. Which methods agree hints at the cause.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.core.arrays import FloatArray, without_nan
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, log_so3, rotation_angle, unit
from rigkit.interop.colmap import colmap_pair, solve_pair
from rigkit.reconstruction.calibration_shifts import CalibrationShifts
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.relative_pose.refinement.refine import POSE_FREEDOM
from rigkit.validation.check import Check, compare
from rigkit.validation.colmap_method import colmap_reconstruction
from rigkit.validation.measure import Measured, measure
from rigkit.validation.planes import face_angle, fit_moved
from rigkit.validation.pnp import AnglesDeg, moved_pnp, planar_pnp

TWO_VIEW = "pycolmap two-view"
ADJUSTED = "pycolmap bundle adjustment"
PNP = "planar PnP"
OTHER_CHAIN = "other chain"
CROSS_COVERAGE = 4.0
"""A data set of eight pairs has 150 comparisons: at four sigmas one such data set in a hundred has a false alarm, at
three sigmas every third, at two every one."""
REPORTED_FIELDS = (
    *("name", "rotation_difference_deg", "direction_difference_deg", "baseline_mm"),
    *("rms_px", "variance_factor", "used", "excluded"),
)
"""Fields of a method in `crosscheck.json`, besides its angles."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class IndependentMethod:
    """The result of another method, and its difference to our reconstruction.

    Attributes
    ----------
    name : "pycolmap two-view", "pycolmap bundle adjustment", "planar PnP", "rectified chain".
    ours, cam2_from_cam1 : our relative pose, and its own, mm; both are scaled by the squares.
    covariance : (6, 6) of (left rotation perturbation rad, translation mm), NaN if the method has none.
    angles_deg : (a, b) -> (angle between the faces, sigma).
    rms_px : its RMS reprojection error, 2-D per observation; NaN if the method has none.
    used, excluded : number of matches used, and of those that the method cannot represent.
    variance_factor : observed over predicted variance of the corners; NaN if the method does not estimate it.
    """

    name: str
    ours: Rigid3
    cam2_from_cam1: Rigid3
    covariance: FloatArray
    angles_deg: AnglesDeg
    rms_px: float
    used: int
    excluded: int = 0
    variance_factor: float = np.nan

    @property
    def rotation_difference_deg(self) -> float:
        """The angle between both rotations."""
        return float(np.rad2deg(rotation_angle(self.cam2_from_cam1.rotation @ self.ours.rotation.T)))

    @property
    def direction_difference_deg(self) -> float:
        """The angle between both translations."""
        return float(np.rad2deg(angle_between(self.cam2_from_cam1.translation_mm, self.ours.translation_mm)))

    @property
    def baseline_mm(self) -> float:
        """Its baseline."""
        return float(np.linalg.norm(self.cam2_from_cam1.translation_mm))


@dataclass(frozen=True, eq=False, slots=True)
class CrossCheckReport:
    """The cross-checks of one pair. Raises InputError without any check.

    Attributes
    ----------
    pair_id, affine_method : of the reconstruction.
    methods : result of each method.
    checks : differences against their standard deviations; `how` names the method.
    skipped : methods that could not be used, and why.
    diagnosis : probable causes of failed checks.
    """

    pair_id: str
    affine_method: str
    methods: tuple[IndependentMethod, ...]
    checks: tuple[Check, ...]
    skipped: tuple[str, ...]
    diagnosis: tuple[str, ...]

    __repr__ = brief

    def __post_init__(self) -> None:
        if not self.checks:
            raise InputError(f"pair '{self.pair_id}': no cross-check could be made: {'; '.join(self.skipped)}")

    @property
    def passed(self) -> bool:
        return all(check.passed for check in self.checks)

    def method(self, name: str) -> IndependentMethod:
        """Return the method of that name; raises InputError if it was not used."""
        for method in self.methods:
            if method.name == name:
                return method
        raise InputError(f"no method is called '{name}'; known: {', '.join(w.name for w in self.methods)}")

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists; NaN becomes None."""
        out: dict[str, Any] = {
            "schema": "rigkit.crosscheck/1",
            "pair": self.pair_id,
            "affine_method": self.affine_method,
            "passed": self.passed,
            "methods": [
                {name: getattr(method, name) for name in REPORTED_FIELDS}
                | {
                    "angles_deg": [
                        {"a": a, "b": b, "angle": angle, "sigma": sigma}
                        for (a, b), (angle, sigma) in method.angles_deg.items()
                    ]
                }
                for method in self.methods
            ],
            "checks": [asdict(check) for check in self.checks],
            "skipped": self.skipped,
            "diagnosis": self.diagnosis,
        }
        cleaned: dict[str, Any] = without_nan(out)
        return cleaned

    def to_json(self) -> str:
        """Return `to_dict()` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False)


def crosscheck(
    reconstruction: Reconstruction,
    *,
    other_chain: Reconstruction | None = None,
    shifts: CalibrationShifts | None = None,
    shapes: Mapping[str, BoardShape] | None = None,
    coverage: float = CROSS_COVERAGE,
    seed: int = 0,
) -> CrossCheckReport:
    """Compare a reconstruction with pycolmap, planar PnP, and the same pair in another chain if given.

    Raises InputError if none of the methods could be used.

    Parameters
    ----------
    reconstruction : of one pair.
    other_chain : the same pair reconstructed in other pixels (rectified if this one is raw, or the reverse).
    shifts : from `calibration_shifts`: adds the effect of calibration errors on the difference; None: exact intrinsics.
    shapes : boards, by id, whose corners the calibrations measured: planar PnP uses those, of others the declared ones.
    coverage : largest |difference| / sigma that passes.
    seed : of COLMAP's RANSAC.
    """
    methods: list[IndependentMethod] = []
    skipped: list[str] = []
    attempts: dict[str, Callable[[], list[IndependentMethod]]] = {
        "pycolmap": lambda: _colmap_methods(reconstruction, seed),
        "planar PnP": lambda: [_pnp_method(reconstruction, shapes)],
    }
    for name, attempt in attempts.items():
        try:
            methods += attempt()
        except DegenerateError as error:
            skipped.append(f"{name}: {error}")
    if any(method.name == TWO_VIEW and np.isnan(method.covariance).all() for method in methods):
        skipped.append(f"{TWO_VIEW}: its own bundle adjustment changes it by more than its uncertainty")
    if other_chain is not None:
        methods.append(compare_chains(reconstruction, other_chain, OTHER_CHAIN))
    measured = measure(reconstruction)
    pnp_sigmas: dict[str, float] = {}
    if shifts is not None and any(method.name == PNP for method in methods):
        pnp_sigmas = _difference_sigmas(measured, shifts, shapes)
    checks = [check for method in methods for check in _checks(reconstruction, measured, method, coverage, pnp_sigmas)]
    return CrossCheckReport(
        reconstruction.pair_id,
        reconstruction.affine_method,
        tuple(methods),
        tuple(checks),
        tuple(skipped),
        _diagnosis(reconstruction, checks),
    )


def compare_chains(reconstruction: Reconstruction, other: Reconstruction, name: str) -> IndependentMethod:
    """Return another reconstruction of the same pair as an independent method."""
    return IndependentMethod(
        name=name,
        ours=reconstruction.cam2_from_cam1,
        cam2_from_cam1=other.cam2_from_cam1,
        covariance=_covariance(other),
        angles_deg=_angles(measure(other)),
        rms_px=other.sampson_rms_px,
        used=len(other.cloud),
    )


def _colmap_methods(reconstruction: Reconstruction, seed: int) -> list[IndependentMethod]:
    if len(np.unique(reconstruction.cloud.board_index)) == 1:
        raise DegenerateError(
            "all corners are on one plane, for which two poses fit equally well (planar ambiguity): pycolmap, which "
            "does not use the squares, may find the other one"
        )
    pixels = (reconstruction.pixels1, reconstruction.pixels2)
    pair = colmap_pair(reconstruction.camera1, reconstruction.camera2, *pixels)
    result = solve_pair(pair, seed=seed)
    adjusted = colmap_reconstruction(reconstruction, pair, result)
    baseline = adjusted.baseline_mm
    two_view = Rigid3(result.two_view.rotation, result.two_view.translation_mm * baseline)
    covariance = _covariance(adjusted)
    # If bundle adjustment does not change the two-view pose significantly, its covariance holds for that pose too.
    own_sigma = np.array(_pose_sigmas(adjusted.cam2_from_cam1, covariance)[:2])
    own = adjusted.cam2_from_cam1
    turned, rotated = own.rotation @ two_view.rotation.T, angle_between(own.translation_mm, two_view.translation_mm)
    moved = np.rad2deg([rotation_angle(turned), rotated])
    settled = bool((moved <= CROSS_COVERAGE * own_sigma).all())
    # The change by bundle adjustment is an error of the two-view estimate itself.
    step = two_view.step_from(own)
    of_two_view = covariance + np.outer(step, step) if settled else np.full((6, 6), np.nan)
    bundle = IndependentMethod(
        name=ADJUSTED,
        ours=reconstruction.cam2_from_cam1,
        cam2_from_cam1=own,
        covariance=covariance,
        angles_deg=_angles(measure(adjusted)),
        rms_px=result.rms_px,
        used=result.inliers,
        excluded=int((~pair.used).sum()),
    )
    before = replace(
        bundle, name=TWO_VIEW, cam2_from_cam1=two_view, covariance=of_two_view, angles_deg={}, rms_px=np.nan
    )
    return [before, bundle]


def _pnp_method(reconstruction: Reconstruction, shapes: Mapping[str, BoardShape] | None) -> IndependentMethod:
    found = planar_pnp(reconstruction, shapes)
    return IndependentMethod(
        name=PNP,
        ours=reconstruction.cam2_from_cam1,
        cam2_from_cam1=found.cam2_from_cam1,
        covariance=found.covariance,
        angles_deg=found.angles_deg,
        rms_px=found.rms_rad * reconstruction.camera1.focal_px,
        used=found.count,
        variance_factor=found.variance_factor,
    )


def sigma_of_difference(ours: float, theirs: float, freedom: int) -> float:
    """Return the standard deviation of the difference of two estimates from the same corners, from those of both.

    Notes
    -----
    If the more certain estimate is efficient, the error of the other is the sum of its error and an independent part:
    Var(a - b) = |Var a - Var b| (Hausman, Econometrica 46, 1978). Variances are estimated from residuals, with relative
    standard deviation sqrt(2 / freedom); that part of the larger variance is added.
    """
    a, b = ours**2, theirs**2
    return float(np.sqrt(abs(a - b) + np.sqrt(2.0 / max(freedom, 2)) * max(a, b)))


def _covariance(reconstruction: Reconstruction) -> FloatArray:
    """Return the covariance (6, 6) of its pose; NaN if unknown."""
    known = reconstruction.pose_covariance
    return np.full((6, 6), np.nan) if known is None else known


def _angles(measured: Measured) -> AnglesDeg:
    return {two: measured.angle_deg(*two) for two in combinations(measured.boards, 2)}


def _checks(
    reconstruction: Reconstruction,
    measured: Measured,
    method: IndependentMethod,
    coverage: float,
    pnp_sigmas: Mapping[str, float],
) -> list[Check]:
    """Return the checks of one method, with the standard deviation of a difference of estimates from the same corners.

    Quantities without uncertainty are not checked. Calibration errors change the results of all epipolar methods alike;
    only for planar PnP do they enter the difference, with `pnp_sigmas`.
    """
    rows_of: list[tuple[str, str, str, tuple[float, float], tuple[float, float]]] = []
    ours = _angles(measured)
    sigmas = pnp_sigmas if method.name == PNP else {}
    sigma = _pose_sigmas(method.cam2_from_cam1, method.covariance)
    if all(np.isfinite(value) for value in sigma):
        own = _pose_sigmas(reconstruction.cam2_from_cam1, _covariance(reconstruction))
        rows = (
            ("rotation", "deg", 0.0, method.rotation_difference_deg),
            ("translation direction", "deg", 0.0, method.direction_difference_deg),
            ("baseline", "mm", method.baseline_mm, reconstruction.baseline_mm),
        )
        for (name, unit, other, value), theirs, mine in zip(rows, sigma, own, strict=True):
            rows_of.append((name, name, unit, (other, theirs), (value, mine)))
    for (a, b), (angle, angle_sigma) in method.angles_deg.items():
        if (a, b) in ours:
            rows_of.append((f"angle {a}-{b}", "angle", "deg", (angle, angle_sigma), ours[a, b]))
    checks = []
    for name, kind, unit, (other, theirs), (value, mine) in rows_of:
        ours_sigma, their_sigma = (sigma if np.isfinite(sigma) else 0.0 for sigma in (mine, theirs))
        of_corners = sigma_of_difference(ours_sigma, their_sigma, method.used - POSE_FREEDOM)
        combined = float(np.hypot(of_corners, sigmas.get(name, 0.0)))
        known = (other, theirs, method.name)
        checks.append(compare(name, kind, unit, known, (value, mine), coverage, method.used, combined_sigma=combined))
    return checks


def _difference_sigmas(
    measured: Measured, shifts: CalibrationShifts, shapes: Mapping[str, BoardShape] | None
) -> dict[str, float]:
    """Return the standard deviations, from the calibrations, of the differences between ours and planar PnP."""
    every = (shifts.base, *shifts.moved)
    cloud, boards = shifts.base.cloud, shifts.base.boards
    points = np.array([moved.cloud.points_mm for moved in every])
    normals = {}
    for index, board in enumerate(boards):
        if board.board_id in measured.boards:
            like = measured.boards[board.board_id].plane
            normals[board.board_id], _ = fit_moved(points[:, cloud.board_index == index], like)
    rows: list[dict[str, FloatArray]] = []
    for m, (moved, (pose, angles_deg)) in enumerate(zip(every, moved_pnp(every, shapes), strict=True)):
        ours = moved.cam2_from_cam1
        row = {
            "rotation": log_so3(pose.rotation @ ours.rotation.T),
            "translation direction": unit(pose.translation_mm) - unit(ours.translation_mm),
        }
        for (a, b), (value, _) in angles_deg.items():
            row[f"angle {a}-{b}"] = face_angle(normals[a][m], normals[b][m]) - np.deg2rad(value)
        row = {name: np.rad2deg(value) for name, value in row.items()}
        rows.append(row | {"baseline": np.asarray(moved.baseline_mm - np.linalg.norm(pose.translation_mm))})
    base, *others = rows
    return {name: float(np.sqrt(sum(np.sum((row[name] - base[name]) ** 2) for row in others))) for name in base}


def _pose_sigmas(pose: Rigid3, covariance: FloatArray) -> tuple[float, float, float]:
    """Return the RMS error of the rotation and of the translation's direction, deg, and of its length, mm."""
    length = float(np.linalg.norm(pose.translation_mm))
    along = pose.translation_mm / length
    translation = covariance[3:, 3:]
    lengthwise = float(along @ translation @ along)
    crosswise = max(float(np.trace(translation)) - lengthwise, 0.0)
    turn = np.rad2deg(np.sqrt(np.trace(covariance[:3, :3])))
    return float(turn), float(np.rad2deg(np.sqrt(crosswise) / length)), float(np.sqrt(lengthwise))


def _diagnosis(reconstruction: Reconstruction, checks: Sequence[Check]) -> tuple[str, ...]:
    """Return the probable causes, from which methods disagree with ours."""
    failed = {name: {c.kind for c in checks if c.how == name and not c.passed} for name in {c.how for c in checks}}
    colmap, pnp, chain = (failed.get(name, set()) for name in (ADJUSTED, PNP, OTHER_CHAIN))
    out = []
    if colmap and pnp:
        out.append(
            f"relative pose: pycolmap and planar PnP both contradict it; does pose type '{reconstruction.pose_type}' "
            "(and the level's sigma) hold for this pair?"
        )
    elif colmap:
        out.append("epipolar geometry: pycolmap finds another pose from the same corners; planar PnP agrees with ours")
    elif pnp:
        out.append(
            "calibration or board: planar PnP disagrees while epipolar geometry agrees; check square sizes, "
            "flatness and the calibration of this lens"
        )
    if chain:
        out.append("rectification: raw and rectified pixels give different results; check the rectified views")
    return tuple(out)
