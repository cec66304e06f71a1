"""A declared pose type, level or board size that is wrong fails its own check, with the true value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from helpers.board_scenes import noisy_pair, regular_camera
from helpers.reconstructions import BOARDS

from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.core.truth import MeasuredAngle, PairTruth
from rigkit.geometry.rotation import exp_so3
from rigkit.identification.board_ids import BOARD_SIDES
from rigkit.reconstruction.calibration_shifts import calibration_shifts
from rigkit.reconstruction.geometry import PoseTypeDecision
from rigkit.reconstruction.reconstruct import Reconstruction, reconstruct_pair
from rigkit.relative_pose.refinement.select import PoseTypeEvidence, TypeEvidence
from rigkit.synthetic.pairs import trihedral_pair
from rigkit.validation.checks import validate, validate_each
from rigkit.validation.declarations import contradicted_boards, declaration_checks

TRUTH = PairTruth(None, (MeasuredAngle("plane1", "plane2", 90.0, 0.3, "set square"),))


def declared(
    true: PoseType,
    printed: PoseType,
    rng: np.random.Generator,
    level_deg: float = 0.2,
    boards: Sequence[Board] = BOARDS,
    declared_level_deg: float = 0.2,
) -> Reconstruction:
    """Return a reconstruction of a pair of one pose type that was declared another, or with `boards` declared."""
    scene = trihedral_pair(
        BOARDS, regular_camera(), true, rng, level_sigma_deg=level_deg, distance=(0.9, 1.3), walls=False
    )
    pair = noisy_pair(scene, BOARDS, rng, 0.03, declared=boards)
    return reconstruct_pair(pair, pose_type=printed, level_sigma_rad=np.deg2rad(declared_level_deg))


@pytest.mark.parametrize("pose_type", [PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD])
def test_what_holds_passes(rng: np.random.Generator, pose_type: PoseType) -> None:
    report = validate(declared(pose_type, pose_type, rng), TRUTH)
    assert report.check(f"pose type {pose_type}").passed
    assert report.check("level").passed
    assert report.passed


@pytest.mark.parametrize(
    ("true", "printed"), [(PoseType.FORWARD, PoseType.STANDARD), (PoseType.STANDARD, PoseType.FORWARD)]
)
def test_another_pose_type_fails_by_a_right_angle(rng: np.random.Generator, true: PoseType, printed: PoseType) -> None:
    report = validate(declared(true, printed, rng), TRUTH)
    row = report.check(f"pose type {printed}")
    assert not row.passed
    assert not report.passed
    assert row.ours == pytest.approx(90.0, abs=1.0)
    assert report.check("level").passed


def test_a_level_that_was_off_fails_with_its_angle(rng: np.random.Generator) -> None:
    report = validate(declared(PoseType.GENERAL, PoseType.PLANAR, rng), TRUTH)
    row = report.check("level")
    assert not row.passed
    assert row.ours > 5.0
    assert row.k > row.limit_k


@pytest.mark.parametrize("pose_type", [PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD])
def test_an_exact_level_that_was_off_by_tenths_of_a_degree_fails_and_bends_nothing(
    rng: np.random.Generator, pose_type: PoseType
) -> None:
    """Held exactly, it bends boards by degrees; where it holds it is used as declared."""
    exact = declared(pose_type, pose_type, rng, level_deg=0.0, declared_level_deg=0.0)
    assert validate(exact, TRUTH).passed
    assert exact.geometry is not None and exact.geometry.decision.level_sigma_rad is None
    off = declared(pose_type, pose_type, rng, level_deg=0.4, declared_level_deg=0.0)
    assert any("held to 0.20 deg instead of exactly" in note for note in off.notes)
    report = validate(off, TRUTH)
    assert not report.check(f"pose type {pose_type}").passed
    assert all(check.passed for check in report.checks if check.kind == "angle")


@pytest.mark.parametrize(("axis_px", "passes"), [(0.1, False), (10.0, True)])
def test_a_pose_type_is_not_called_wrong_where_the_calibration_is(
    rng: np.random.Generator, axis_px: float, passes: bool
) -> None:
    """A principal point that is 10 px too low lets a level baseline rise by 0.4 degrees."""
    true = regular_camera()
    off = true.with_parameters(true.parameters + np.array([0.0, 0.0, 0.0, 10.0]))
    scene = trihedral_pair(BOARDS, true, PoseType.PLANAR, rng, level_sigma_deg=0.0, distance=(0.9, 1.3), walls=False)
    pair = noisy_pair(scene, BOARDS, rng, 0.03, known_as=off)
    found = reconstruct_pair(pair, pose_type=PoseType.PLANAR, level_sigma_rad=0.0)
    known = UncertainCamera(off, np.diag([0.1, 0.1, axis_px, axis_px]) ** 2)
    without, report = (validate(found, TRUTH, shifts=s) for s in (None, calibration_shifts(found, known)))
    assert not without.check("pose type planar").passed
    assert report.check("pose type planar").passed == passes


def test_a_type_whose_pose_sees_nothing_in_front_is_not_checked(rng: np.random.Generator) -> None:
    found = declared(PoseType.FORWARD, PoseType.FORWARD, rng)
    assert found.geometry is not None and found.geometry.decision.evidence is not None
    evidence = replace(found.geometry.decision.evidence, types=())
    geometry = replace(found.geometry, decision=replace(found.geometry.decision, evidence=evidence))
    checks, unchecked = declaration_checks(replace(found, geometry=geometry))
    assert not checks
    assert [words.split(":")[0] for words in unchecked] == ["pose type forward", "level"]


def test_a_chance_is_told_as_that_many_standard_deviations(rng: np.random.Generator) -> None:
    """Half a level off, a chance of 0.3, holds; 40 degrees off, one in 10^30, fails by as many sigmas."""
    level = np.deg2rad(0.2)
    types = tuple(
        TypeEvidence(pose_type=name, log_evidence=log, probability=0.5, deviation_rad=np.deg2rad(off), p_value=chance)
        for name, log, off, chance in ((PoseType.PLANAR, 0.0, 0.1, 0.3173), (PoseType.STANDARD, -60.0, 40.0, 1e-30))
    )
    decision = PoseTypeDecision(PoseType.STANDARD, PoseType.STANDARD, level, PoseTypeEvidence(types, level), ())
    found = declared(PoseType.STANDARD, PoseType.STANDARD, rng)
    assert found.geometry is not None
    found = replace(found, geometry=replace(found.geometry, decision=decision))
    (standard, planar), unchecked = declaration_checks(found)
    assert not unchecked and (standard.name, planar.name) == ("pose type standard", "level")
    assert planar.passed and planar.ours == pytest.approx(0.1) and planar.count == len(found.cloud)
    # One standard deviation has a chance of 0.3173 to be exceeded: that of the level itself, not less.
    assert planar.k == pytest.approx(1.0, abs=1e-3) and planar.measured_sigma == pytest.approx(0.2)
    assert not standard.passed and standard.ours == pytest.approx(40.0)
    # Both tails of the normal distribution.
    assert 2.0 * NormalDist().cdf(-standard.k) == pytest.approx(1e-30, rel=1e-6)
    assert standard.combined_sigma == pytest.approx(40.0 / standard.k)


def test_nothing_declared_is_nothing_to_check(rng: np.random.Generator) -> None:
    for printed in (PoseType.GENERAL, PoseType.AUTO):
        report = validate(declared(PoseType.STANDARD, printed, rng), TRUTH)
        assert {check.kind for check in report.checks} == {"angle"}


def test_a_board_of_another_size_than_declared_fails_with_its_size(rng: np.random.Generator) -> None:
    wrong = replace(BOARDS[1], square_x_mm=1.04 * BOARDS[1].square_x_mm, square_y_mm=1.04 * BOARDS[1].square_y_mm)
    report = validate(declared(PoseType.GENERAL, PoseType.GENERAL, rng, boards=[BOARDS[0], wrong, BOARDS[2]]), TRUTH)
    row = report.check(f"size {wrong.board_id}")
    assert not row.passed and not report.passed
    assert row.ours == pytest.approx(BOARDS[1].square_x_mm, rel=0.01) and row.measured == wrong.square_x_mm
    assert [check.name for check in report.checks if check.kind == "board size"] == [row.name]


@pytest.mark.parametrize(
    ("yaw_deg", "declared_sides", "wrong"),
    [
        (0.0, ("left", "right"), False),
        (40.0, ("left", "right"), False),
        (-40.0, ("left", "right"), False),
        (0.0, ("right", "left"), True),
        (40.0, ("right", "left"), True),
        (80.0, ("left", "right"), True),
    ],
)
def test_the_walls_of_a_corner_keep_their_sides_when_the_camera_turns(
    yaw_deg: float, declared_sides: tuple[str, str], wrong: bool, rng: np.random.Generator
) -> None:
    """Two walls at a right angle, seen from between them, both stand half-way to the back; the floor is as it is."""
    found = validate(declared(PoseType.GENERAL, PoseType.GENERAL, rng), TRUTH).boards
    half = np.sqrt(0.5)
    turn = exp_so3([0.0, np.radians(yaw_deg), 0.0])
    normals = [turn @ n for n in ([half, 0.0, -half], [-half, 0.0, -half], [0.0, -1.0, 0.0])]
    boards = {
        name: replace(result, plane=replace(result.plane, normal=normal))
        for name, result, normal in zip(("a", "b", "c"), found, normals, strict=True)
    }
    layout = dict(zip(("a", "b", "c"), (*declared_sides, "floor"), strict=True))
    assert any(check.kind == "layout" for check in contradicted_boards(boards, layout)) == wrong


def test_a_board_on_another_side_than_declared_fails(rng: np.random.Generator) -> None:
    reconstruction = declared(PoseType.GENERAL, PoseType.GENERAL, rng)
    plane = validate(reconstruction, TRUTH).boards[0]
    facing = {side: float(np.dot(to, plane.plane.normal)) for side, to in BOARD_SIDES.items()}
    for side, holds in ((max(facing, key=lambda s: facing[s]), True), (min(facing, key=lambda s: facing[s]), False)):
        (report,) = validate_each([reconstruction], TRUTH, [None], layout={plane.board.board_id: side})
        rows = [check for check in report.checks if check.kind == "layout"]
        assert [row.passed for row in rows] == ([] if holds else [False])
        assert report.passed == holds
