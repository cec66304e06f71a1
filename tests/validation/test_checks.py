"""Checks of exact reconstructions: right ones pass, each wrong one fails only its own check."""

from __future__ import annotations

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.reconstructions import BOARDS, CAM2_FROM_CAM1, make_reconstruction

from rigkit.core.arrays import BoolArray, FloatArray, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.truth import Feature, MeasuredAngle, MeasuredDistance, MeasuredLength, PairTruth
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.geometry.triangulation import triangulate_rays
from rigkit.reconstruction.board_planes import BoardPlanes
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.check import compare
from rigkit.validation.checks import validate, validate_each
from rigkit.validation.fitted_planes import FittedPlanes
from rigkit.validation.measure import Measured, _distance_scatter, measure

BASELINE_MM = float(np.linalg.norm(CAM2_FROM_CAM1.translation_mm))
EXACT = 1e-9
"""Exact geometry, in mm or degrees: rounding only."""
DRAWS = 400
SIGMA_RATIO = (0.9, 1.1)
"""Of 400 draws: three of their own standard deviations, 3.5 %."""
LINEAR = 0.01
"""Central differences of one standard deviation leave third-order terms."""

PAIRS = (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))


def truth(baseline_mm: float = BASELINE_MM, angles_deg: tuple[float, ...] = (90.0, 90.0, 90.0)) -> PairTruth:
    angles = tuple(MeasuredAngle(a, b, deg, 0.3, "set square") for (a, b), deg in zip(PAIRS, angles_deg, strict=True))
    return PairTruth(MeasuredLength(baseline_mm, 2.0, "steel rule"), angles)


def distance(a: str, b: str, value_mm: float = 100.0) -> MeasuredDistance:
    return MeasuredDistance(Feature.parse(a), Feature.parse(b), value_mm, 1.0, "steel rule")


def test_exact_geometry_passes_with_nothing_left_over() -> None:
    report = validate(make_reconstruction(), truth())
    assert report.passed
    assert [check.name for check in report.checks] == ["baseline", *(f"angle {a}-{b}" for a, b in PAIRS)]
    for check in report.checks:
        assert abs(check.difference) < EXACT
    assert report.check("baseline").count == 144
    assert report.check("angle plane1-plane2").count == 96
    assert [a.error_deg for a in report.angles] == pytest.approx([0.0, 0.0, 0.0], abs=EXACT)


@pytest.mark.parametrize(
    ("angles", "failing"),
    [
        ((91.6, 90.0, 90.0), {"angle plane1-plane2"}),
        ((90.0, 88.4, 90.0), {"angle plane1-plane3"}),
        ((91.6, 90.0, 88.4), {"angle plane1-plane2", "angle plane2-plane3"}),
    ],
)
def test_walls_that_are_not_perpendicular_fail_their_own_check(angles: tuple[float, ...], failing: set[str]) -> None:
    report = validate(make_reconstruction(angles_deg=angles), truth())
    assert {check.name for check in report.checks if not check.passed} == failing
    assert not report.passed
    # The same walls, measured as they are, pass.
    assert validate(make_reconstruction(angles_deg=angles), truth(angles_deg=angles)).passed


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_wrong_stated_baseline_fails_the_baseline_only(factor: float) -> None:
    report = validate(make_reconstruction(), truth(baseline_mm=BASELINE_MM * factor))
    assert {check.name for check in report.checks if not check.passed} == {"baseline"}
    assert report.check("baseline").difference == pytest.approx(BASELINE_MM * (1.0 - factor))


def test_the_verdict_is_k_combined_sigmas() -> None:
    known = (100.0, 0.6, "rule")
    check = compare("x", "distance", "mm", known, (101.9, 0.8), 2.0, 10)
    assert check.passed
    assert (check.combined_sigma, check.k) == pytest.approx((1.0, 1.9))
    assert not compare("x", "distance", "mm", known, (97.9, 0.8), 2.0, 10).passed
    assert compare("x", "distance", "mm", known, (97.9, 0.8), 3.0, 10).passed
    # What we could not predict never makes it easier.
    assert compare("x", "distance", "mm", known, (101.0, np.nan), 2.0, 10).combined_sigma == 0.6
    assert not compare("x", "distance", "mm", known, (np.nan, 0.8), 2.0, 10).passed


def test_missing_board_is_said_and_does_not_pass() -> None:
    report = validate(make_reconstruction(keep=(0, 1)), truth())
    assert [check.name for check in report.checks] == ["baseline", "angle plane1-plane2"]
    assert all(check.passed for check in report.checks)
    assert len(report.unchecked) == 2
    assert "'plane3' was not reconstructed" in report.unchecked[0]
    assert not report.passed


def test_a_report_without_rows_cannot_be_built() -> None:
    with pytest.raises(InputError, match="nothing measured can be checked"):
        validate(make_reconstruction(), PairTruth())
    only = PairTruth(angles=(MeasuredAngle("plane1", "plane3", 90.0, 0.3, "square"),))
    with pytest.raises(InputError, match="plane3"):
        validate(make_reconstruction(keep=(0, 1)), only)


def test_a_board_with_three_points_is_degenerate() -> None:
    made = make_reconstruction()
    few = np.r_[0:99]
    cloud = replace(
        made.cloud,
        **{
            name: getattr(made.cloud, name)[few]
            for name in ("points_mm", "normals", "colours", "board_index", "grid", "sigma_mm", "normal_sigma_rad")
        },
    )
    cut = replace(
        made, cloud=cloud, matches=made.matches.select(few), pixels1=made.pixels1[few], pixels2=made.pixels2[few]
    )
    with pytest.raises(DegenerateError, match=r"plane3.*3 points"):
        validate(cut, truth())


def test_distances_between_corners_centres_and_planes() -> None:
    measured = measure(make_reconstruction())
    board = BOARDS[0]
    found, _ = measured.distance_mm(distance("plane1[0,0]", "plane1[7,5]"))
    assert found == pytest.approx(np.hypot(7 * board.square_x_mm, 5 * board.square_y_mm), abs=1e-6)
    # The centres lie 330 mm from the apex, at 35.26 degrees to the diagonal, the axis of the corner.
    apart, _ = measured.distance_mm(distance("plane1.centre", "plane2.centre"))
    radius = 330.0 * np.sqrt(1.0 / 3.0)
    assert apart == pytest.approx(radius * np.sqrt(3.0), abs=1e-6)
    across, _ = measured.distance_mm(distance("plane1.centre", "plane2"))
    assert across == pytest.approx(measured.distance_mm(distance("plane2", "plane1.centre"))[0], abs=1e-12)
    assert 0.0 < across < apart


def test_report_is_json_without_nan() -> None:
    report = validate(make_reconstruction(baseline_sigma_mm=float("nan")), truth())
    data = json.loads(report.to_json())
    assert data["passed"] is True
    assert data["baseline_sigma_mm"] is None
    assert data["checks"][0]["name"] == "baseline"
    assert data["boards"][1]["normal_errors"]["count"] == 48


def test_estimators_with_the_same_points_are_judged_as_each_alone() -> None:
    made = make_reconstruction()
    tilted = made.cloud.normals @ exp_so3(np.array([0.01, 0.0, 0.0])).T
    other = replace(made, affine_method="2SDIR", cloud=replace(made.cloud, normals=tilted))
    moved = replace(make_reconstruction(angles_deg=(90.0, 90.0, 91.0)), affine_method="F2UDIR")
    looser = replace(made, affine_method="3SDIR", pose_covariance=1e-6 * np.eye(6))
    every = [made, other, moved, looser]
    together = validate_each(every, truth(), [None] * 4)
    assert [r.to_json() for r in together] == [validate(r, truth()).to_json() for r in every]
    assert len({r.to_json() for r in together}) == 4


def triangulated(made: Reconstruction, pose: Rigid3, noise_px: np.ndarray) -> Reconstruction:
    """The same corners with noise (2, N, 2), seen by cameras in `pose`; no pose covariance."""
    pixels1, pixels2 = made.pixels1 + noise_px[0], made.pixels2 + noise_px[1]
    points, valid = triangulate_rays(
        made.camera1.unproject(pixels1)[0],
        made.camera2.unproject(pixels2)[0],
        pose,
        jacobians1=made.camera1.ray_jacobian(pixels1),
        jacobians2=made.camera2.ray_jacobian(pixels2),
    )
    assert valid.all()
    return replace(made, cloud=replace(made.cloud, points_mm=points), pose_covariance=None)


def quantities(measured: Measured) -> np.ndarray:
    """(value, sigma) of the three angles and of distances of each kind."""
    ways = [
        distance("plane1.centre", "plane2"),
        distance("plane1[0,0]", "plane3[7,5]"),
        distance("plane1[0,0]", "plane1[7,5]"),
    ]
    return np.array([*(measured.angle_deg(a, b) for a, b in PAIRS), *(measured.distance_mm(way) for way in ways)])


def test_pose_uncertainty_is_carried_into_angles_and_distances(rng: np.random.Generator) -> None:
    half = rng.normal(size=(6, 6)) * np.array([2e-4] * 3 + [0.3] * 3)[:, None]
    exact = make_reconstruction(pose_covariance=half @ half.T)
    pose, still = exact.cam2_from_cam1, np.zeros((2, 144, 2))
    changes = []
    # One standard deviation each way along what the pose's errors are made of: their squares sum to the variance.
    for move in half.T:
        there = []
        for change in (move, -move):
            moved = Rigid3(exp_so3(change[:3]) @ pose.rotation, pose.translation_mm + change[3:])
            there.append(quantities(measure(triangulated(exact, moved, still)))[:, 0])
        changes.append(0.5 * (there[0] - there[1]))
    ratio = np.sqrt(np.sum(np.square(changes), axis=0)) / quantities(measure(exact))[:, 1]
    assert (np.abs(ratio - 1.0) < LINEAR).all(), ratio


def test_scatter_of_the_corners_is_carried_into_angles_and_distances(rng: np.random.Generator) -> None:
    exact = make_reconstruction()
    noise = rng.normal(size=(DRAWS, 2, 144, 2)) * 0.1
    found = np.array([quantities(measure(triangulated(exact, exact.cam2_from_cam1, n))) for n in noise])
    ratio = np.std(found[..., 0], axis=0) / np.sqrt(np.mean(found[..., 1] ** 2, axis=0))
    assert (ratio > SIGMA_RATIO[0]).all(), ratio
    assert (ratio < SIGMA_RATIO[1]).all(), ratio


def test_scatter_of_a_distance_is_that_along_it(rng: np.random.Generator) -> None:
    """By differences of the distance between two points, whose covariances are far from round."""
    noise = 0.1 * rng.normal(size=(2, 144, 2))
    exact = make_reconstruction()
    boards = measure(triangulated(exact, exact.cam2_from_cam1, noise)).boards
    a, b = Feature.parse("plane1[7,0]"), Feature.parse("plane2[0,5]")
    (point, own), (other, others) = (boards[f.board_id].feature(f) for f in (a, b))
    slope = [
        (np.linalg.norm(point + step - other) - np.linalg.norm(point - step - other)) / 2e-3
        for step in 1e-3 * np.eye(3)
    ]
    assert _distance_scatter(boards, a, b) == pytest.approx(slope @ (own + others) @ slope, rel=1e-6)


def test_a_pair_of_which_nothing_was_measured_is_not_checked() -> None:
    with pytest.raises(InputError, match="nothing was measured"):
        validate(make_reconstruction(), None)


class Askew(BoardPlanes):
    """Planes that were fitted otherwise: plane1 turned by a degree about plane2's normal, the baseline 1 mm longer."""

    def normal(self, board_id: str) -> FloatArray:
        turn = exp_so3(np.radians(1.0) * _faces()["plane2"]) if board_id == "plane1" else np.eye(3)
        return np.asarray(turn @ _faces()[board_id])

    def has_points(self, board: Board, grid: FloatArray) -> BoolArray:
        raise NotImplementedError

    def points(self, board: Board, grid: FloatArray) -> tuple[Points, FloatArray]:
        raise NotImplementedError


@functools.cache
def _faces() -> dict[str, FloatArray]:
    return {b.board.board_id: b.plane.normal for b in measure(make_reconstruction()).boards.values()}


def test_fitted_planes_stand_beside_the_free_ones_or_judge_in_their_place() -> None:
    t = CAM2_FROM_CAM1.translation_mm
    planes = Askew(
        board_ids=tuple(_faces()),
        cam2_from_cam1=Rigid3(CAM2_FROM_CAM1.rotation, t * (1.0 + 1.0 / BASELINE_MM)),
        covariance=np.diag(np.full(24, 1e-6)),
        calibration_moves=np.zeros((0, 24)),
        variance_factor=1.0,
        count=144,
        gross=0,
    )
    reconstruction = make_reconstruction()
    beside = validate(reconstruction, truth(), fitted=FittedPlanes(planes, None))
    assert beside.planes == "free"
    assert beside.check("angle plane1-plane3").ours == pytest.approx(90.0, abs=EXACT)
    angle = next(a for a in beside.angles if (a.a, a.b) == ("plane1", "plane3"))
    assert angle.coplanar_error_deg == pytest.approx(1.0, abs=1e-6)
    assert angle.lattice_deg is None and angle.lattice_error_deg is None
    assert beside.coplanar_normal_errors["plane1"].mean_deg == pytest.approx(1.0, abs=1e-6)
    judged = validate(reconstruction, truth(), fitted=FittedPlanes(planes, None, "coplanar"))
    assert abs(judged.check("angle plane1-plane3").difference) == pytest.approx(1.0, abs=1e-6)
    assert {c.name for c in judged.checks if not c.passed} == {"angle plane1-plane3"}
    assert judged.check("baseline").ours == judged.baseline_mm == pytest.approx(BASELINE_MM + 1.0)
    assert next(b for b in judged.boards if b.board.board_id == "plane1").normal_errors.mean_deg > 0.99
    reported = json.loads(judged.to_json())
    assert reported["planes"] == "coplanar"
    assert reported["boards"][0]["lattice_normal_errors"] is None
    part = validate(
        reconstruction, truth(), fitted=FittedPlanes(replace(planes, board_ids=("plane1", "plane2")), None, "coplanar")
    )
    assert not part.passed and any("too few corners" in words for words in part.unchecked)
    with pytest.raises(InputError, match="lattice planes were not fitted"):
        FittedPlanes(planes, None, "lattice")
