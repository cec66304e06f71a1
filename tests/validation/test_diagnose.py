"""Every mistake that a person can make is named, and correct data get no suspicion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.board_scenes import detection, fisheye_camera, regular_camera, trihedral_scene
from helpers.reconstructions import BOARDS, CAM2_FROM_CAM1, make_reconstruction

from rigkit.cameras.base import Camera
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.truth import Feature, MeasuredAngle, MeasuredDistance, MeasuredLength, PairTruth
from rigkit.identification.wrong_squares import FittingSquares
from rigkit.validation.checks import ValidationReport, validate
from rigkit.validation.diagnose import camera_fit, diagnose, diagnose_cameras, diagnose_squares

BASELINE_MM = float(np.linalg.norm(CAM2_FROM_CAM1.translation_mm))
CENTRES_MM = 330.0
"""Between two boards' centres in the made scene: their distance from the corner times sqrt(3) sqrt(1/3)."""
SIGMA_PX = 0.02

CAMERAS: dict[str, Camera] = {"regular": regular_camera(), "fisheye": fisheye_camera()}


def reported(
    *,
    boards: tuple[Board, ...] = BOARDS,
    scale: float = 1.0,
    angles: tuple[float, ...] = (90.0, 90.0, 90.0),
    stated_mm: float = BASELINE_MM,
    stated_sigma_mm: float = 1.0,
    stated_deg: float = 90.0,
    distances: bool = True,
    pair_id: str = "made",
) -> ValidationReport:
    """The exact scene, its lengths `scale` times too long, against what was stated."""
    made = make_reconstruction(angles_deg=angles, baseline_sigma_mm=0.2)
    made = replace(
        made,
        pair_id=pair_id,
        boards=boards,
        baseline_mm=scale * made.baseline_mm,
        cloud=replace(made.cloud, points_mm=scale * made.cloud.points_mm),
    )
    stated = tuple(
        MeasuredAngle(a, b, stated_deg if (a, b) == ("plane1", "plane2") else 90.0, 0.3, "set square")
        for a, b in (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))
    )
    ends = [(Feature.parse("plane1.centre"), Feature.parse(f"plane{k}.centre")) for k in (2, 3)]
    lengths = tuple(MeasuredDistance(a, b, CENTRES_MM, 1.0, "steel rule") for a, b in ends)
    return validate(
        made, PairTruth(MeasuredLength(stated_mm, stated_sigma_mm, "rule"), stated, lengths if distances else ())
    )


def test_nothing_is_suspected_where_all_is_well() -> None:
    report = reported()
    assert report.passed
    assert diagnose([report]) == ()


@pytest.mark.parametrize("scale", [0.97, 1.03])
def test_wrong_squares_change_all_lengths(scale: float) -> None:
    found = diagnose([reported(scale=scale)])
    assert len(found) == 1
    assert "square size" in found[0]
    assert f"{50.0 / scale:.2f} mm instead of 50" in found[0]


def test_wrong_squares_show_in_several_pairs() -> None:
    found = diagnose([reported(scale=1.03, distances=False, pair_id=name) for name in ("a", "b")])
    assert len(found) == 1
    assert "square size: all 2 lengths" in found[0]
    # Baselines of a rule that is off are off like that: nothing in the images tells the two apart.
    assert "or every length was misread by this factor" in found[0]


def test_a_misread_baseline_is_recognised_by_the_other_lengths() -> None:
    found = diagnose([reported(stated_mm=BASELINE_MM / 1.03)])
    assert len(found) == 1
    assert "baseline is off by +3.0 %" in found[0]
    assert "misread" in found[0]
    both = diagnose([reported(stated_mm=BASELINE_MM / 1.03, distances=False, pair_id="a"), reported(pair_id="b")])
    assert len(both) == 1
    assert both[0].startswith("pair 'a'")


def test_one_length_alone_leaves_both_possible() -> None:
    found = diagnose([reported(stated_mm=BASELINE_MM / 1.03, distances=False)])
    assert len(found) == 1
    assert "misread, or the squares" in found[0]


def test_one_board_of_another_size_is_named() -> None:
    wrong = replace(BOARDS[1], square_x_mm=48.0, square_y_mm=48.0)
    found = diagnose([reported(boards=(BOARDS[0], wrong, BOARDS[2]), scale=1.01)])
    assert len(found) == 1
    assert "board 'plane2'" in found[0]
    assert "50.00 mm would fit" in found[0]


def test_a_board_that_was_stretched_is_named_once_with_both_sides() -> None:
    """A print that is 97 % as high as was declared, of which two pairs tell."""
    wrong = replace(BOARDS[1], square_y_mm=50.0 / 0.97)
    boards = (BOARDS[0], wrong, BOARDS[2])
    found = diagnose([reported(boards=boards, scale=1.01, pair_id=name) for name in ("near", "far")])
    assert found == (
        "board 'plane2': its squares are reconstructed 3.1 % wider than high relative to the declaration (50.00 x "
        "50.00 mm would fit, 50 x 51.5464 is declared); measure square_x_mm and square_y_mm",
    )


def test_a_board_that_is_a_little_odd_explains_no_length_that_is_far_off() -> None:
    boards = (BOARDS[0], replace(BOARDS[1], square_y_mm=50.3), BOARDS[2])
    found = diagnose([reported(boards=boards, stated_mm=1.15 * BASELINE_MM)])
    assert "baseline is off by -13.0 % while other lengths agree: it was probably misread" in found[0]
    assert "0.6 % wider than high" in found[1] and len(found) == 2


def test_a_declaration_that_is_contradicted_comes_alone() -> None:
    """A level that is stated far too well bends squares and angles."""
    bent = reported(boards=(BOARDS[0], replace(BOARDS[1], square_y_mm=51.0), BOARDS[2]), angles=(88.9, 88.4, 90.0))
    off = replace(bent.checks[0], name="level", kind="level", passed=False)
    found = diagnose([reported(pair_id="well"), replace(bent, checks=(*bent.checks, off))])
    assert len(found) == 1 and found[0].startswith("pair 'made': the images contradict the declared level: declare")


def test_squares_that_are_odd_are_a_cause_where_only_an_independent_method_disagrees() -> None:
    """A board that is a little longer one way, with a baseline that says nothing of it."""
    boards = tuple(replace(board, square_y_mm=50.2) for board in BOARDS)
    passing = replace(reported(boards=boards), checks=reported().checks)
    assert passing.passed and diagnose([passing]) == ()
    (found,) = diagnose([passing], agreed=False)
    assert "0.4 % wider than high" in found and "measure square_x_mm and square_y_mm" in found


def test_boards_that_are_all_stretched_alike_are_one_cause() -> None:
    boards = tuple(replace(board, square_y_mm=50.0 / 0.97) for board in BOARDS)
    found = diagnose([reported(boards=boards, scale=1.02, pair_id=name) for name in ("near", "far")])
    assert found == (
        "boards 'plane1', 'plane2', 'plane3': their squares are reconstructed 3.1 % wider than high relative to the "
        "declaration; measure square_x_mm and square_y_mm, or check fx / fy of the calibration",
    )


def test_a_board_that_fits_nowhere_is_named_with_its_size_or_its_place() -> None:
    one, alike = (FittingSquares(b, 1.25, "the 8x6 grid round (9, 7)") for b in (BOARDS[:1], BOARDS[1:]))
    size = "would be consistent with the others with squares of 62.5 mm (50 is declared)"
    assert diagnose_squares([]) == ()
    assert diagnose_squares([one, alike]) == (
        f"board 'plane1' {size}, or one of 'plane2', 'plane3', the 8x6 grid round (9, 7) in image 1, {size}; measure "
        "them again",
    )


def test_a_board_in_another_place_than_declared_is_named() -> None:
    found = diagnose([reported(angles=(91.6, 90.0, 88.4), distances=False)])
    assert len(found) == 1
    assert "'plane2' is not at the measured angles" in found[0]


def test_one_misread_angle_is_recognised_by_the_others() -> None:
    found = diagnose([reported(stated_deg=88.0, distances=False)])
    assert found == (
        "pair 'made': plane1-plane2: 88 was probably misread: the images show 90.00 deg (the other angles agree); "
        "measure it again",
    )


def test_planes_of_points_and_of_squares_that_disagree_blame_no_ruler() -> None:
    report = reported(angles=(91.6, 90.0, 90.0), distances=False)
    bent = tuple(replace(a, lattice_deg=90.0) if (a.a, a.b) == ("plane1", "plane2") else a for a in report.angles)
    found = diagnose([replace(report, angles=bent)])
    assert len(found) == 1
    assert "a board is bent, or the calibration does not fit" in found[0]


def test_a_supplement_is_recognised() -> None:
    found = diagnose([reported(angles=(91.6, 90.0, 90.0), stated_deg=88.4, distances=False)])
    assert len(found) == 1
    assert "supplement" in found[0]


def detected(rng: np.random.Generator, camera: Camera) -> list[list[BoardDetection]]:
    scene = trihedral_scene(rng, BOARDS, camera)
    return [
        [detection(b, pixels[b.board_id], rng, SIGMA_PX) for b in BOARDS] for pixels in (scene.pixels1, scene.pixels2)
    ]


def test_the_right_calibration_fits_to_the_noise(rng: np.random.Generator) -> None:
    for camera in CAMERAS.values():
        for found in detected(rng, camera):
            # 2-D, six of 96 degrees of freedom go into the pose: within 20 % for 144 corners.
            assert camera_fit(camera, found, BOARDS) == pytest.approx(SIGMA_PX * np.sqrt(2.0 * 90 / 96), rel=0.2)
            turned = [one.turned(1) for one in found]
            assert camera_fit(camera, turned, BOARDS) == pytest.approx(camera_fit(camera, found, BOARDS), rel=1e-6)


@pytest.mark.parametrize("true", CAMERAS)
def test_the_other_lens_is_named(rng: np.random.Generator, true: str) -> None:
    one, two = detected(rng, CAMERAS[true])
    wrong = next(name for name in CAMERAS if name != true)
    assert diagnose_cameras("p", (true, true), (one, two), BOARDS, CAMERAS) == ()
    found = diagnose_cameras("p", (wrong, wrong), (one, two), BOARDS, CAMERAS)
    assert len(found) == 2
    for number, words in enumerate(found, start=1):
        assert f"image {number} fits camera '{true}'" in words
    # With no other calibration to compare, it still does not fit.
    alone = diagnose_cameras("p", (wrong, wrong), (one, two), BOARDS, {wrong: CAMERAS[wrong]})
    assert len(alone) == 2
    assert "does not fit the calibration" in alone[0]


@pytest.mark.parametrize("stretch", [1.04, 0.96])
def test_stretched_boards_are_named_before_a_changed_lens(rng: np.random.Generator, stretch: float) -> None:
    one, two = detected(rng, CAMERAS["regular"])
    declared = [replace(board, square_y_mm=board.square_y_mm / stretch) for board in BOARDS]
    found = diagnose_cameras("p", ("regular", "regular"), (one, two), declared, {"regular": CAMERAS["regular"]})
    assert len(found) == 2
    off = max(stretch, 1.0 / stretch) - 1.0
    for words in found:
        assert f"squares {100.0 * off:.1f} % {'higher than wide' if stretch > 1.0 else 'wider than high'}" in words
        assert "refocused" not in words
    # A lens that was zoomed in is no board.
    zoomed = [replace(d, pixels=d.pixels * 1.2) for d in one]
    (words,) = diagnose_cameras("p", ("regular", "regular"), (zoomed, two), BOARDS, {"regular": CAMERAS["regular"]})
    assert "refocused" in words


def test_swapped_images_or_cameras_are_named(rng: np.random.Generator) -> None:
    one, two = detected(rng, CAMERAS["regular"])[0], detected(rng, CAMERAS["fisheye"])[1]
    assert diagnose_cameras("p", ("regular", "fisheye"), (one, two), BOARDS, CAMERAS) == ()
    found = diagnose_cameras("p", ("regular", "fisheye"), (two, one), BOARDS, CAMERAS)
    assert len(found) == 1
    assert "swapped" in found[0]


def test_cameras_of_two_image_sizes_in_one_pair(rng: np.random.Generator) -> None:
    small, large = CAMERAS["regular"], CAMERAS["fisheye"]
    doubled = Pinhole((2 * small.size_px[0], 2 * small.size_px[1]), np.array([1500.0, 1500.0, 700.0, 500.0]))
    one, two = detected(rng, small)[0], detected(rng, large)[1]
    cameras = CAMERAS | {"large": doubled}
    assert diagnose_cameras("p", ("regular", "fisheye"), (one, two), BOARDS, cameras) == ()
    # What was declared does not fit, and no camera of another image size is proposed for it.
    found = diagnose_cameras("p", ("large", "fisheye"), (one, two), BOARDS, cameras)
    assert len(found) == 1
    assert "does not fit the calibration of 'large'" in found[0]


def test_no_board_of_known_size_says_nothing(rng: np.random.Generator) -> None:
    found = detected(rng, CAMERAS["regular"])[0]
    assert np.isnan(camera_fit(CAMERAS["regular"], found, [Board("other", 5, 4, 10.0, 10.0)]))
    assert diagnose_cameras("p", ("regular", "regular"), (found, []), [Board("x", 5, 4, 1.0, 1.0)], CAMERAS) == ()


@pytest.mark.parametrize(("unit", "factor"), [("m", 1000.0), ("cm", 10.0), ("inches", 25.4)])
def test_a_length_in_another_unit_is_named(unit: str, factor: float) -> None:
    stated_mm, sigma_mm = BASELINE_MM / factor, 1.0 / factor
    one = diagnose([reported(stated_mm=stated_mm, stated_sigma_mm=sigma_mm, distances=False)])
    assert len(one) == 1
    assert f"written in {unit}?" in one[0]
    beside = diagnose([reported(stated_mm=stated_mm, stated_sigma_mm=sigma_mm)])
    assert f"written in {unit}?" in beside[0]
    assert not any("written in" in words for words in diagnose([reported(stated_mm=BASELINE_MM / 1.1)]))


def test_an_angle_in_radians_is_named() -> None:
    found = diagnose([reported(stated_deg=float(np.radians(90.0)))])
    assert found == ("pair 'made': plane1-plane2: written in radians? Angles are in degrees",)


def test_baselines_of_two_pairs_that_were_exchanged_are_named() -> None:
    near = reported(pair_id="near", stated_mm=0.6 * BASELINE_MM, distances=False)
    far = reported(pair_id="far", scale=0.6, stated_mm=BASELINE_MM, distances=False)
    words = (
        "pairs 'near' and 'far': each baseline matches the measurement of the other pair: they were probably exchanged"
    )
    assert words in diagnose([near, far])
    off = reported(pair_id="far", scale=0.6, stated_mm=1.1 * BASELINE_MM, distances=False)
    assert not any("exchanged" in one for one in diagnose([near, off]))


def test_corners_of_different_boards_are_not_called_wrong_squares() -> None:
    report = reported()
    odd = replace(report.boards[0], square_x_ratio=18.0, square_y_ratio=1.0)
    failed = replace(report, boards=(odd, *report.boards[1:]), checks=(replace(report.checks[0], passed=False),))
    assert any("matched" in words and "plane1" in words for words in diagnose([failed]))
    assert not any("measure square_x_mm" in words for words in diagnose([failed]))
