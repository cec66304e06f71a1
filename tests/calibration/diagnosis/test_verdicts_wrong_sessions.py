"""Sessions with one thing wrong: the first verdict names it, and never says "good"."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, SIZE, lens, random_views
from helpers.session_scenes import NOISE_PX, poses, seen

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.cameras.compare import compare_cameras
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.core.findings import Severity, worst
from rigkit.geometry.rotation import exp_so3


def first(result: Calibration) -> str:
    assert result.verdicts[0].severity is not Severity.GOOD
    assert result.verdicts[0].remedy
    return result.verdicts[0].message


def prefixed(views: list[BoardView], prefix: str) -> list[BoardView]:
    return [replace(view, image=prefix + view.image) for view in views]


@pytest.mark.parametrize("order", ["one after the other", "in turns"])
def test_two_cameras_that_see_the_board_at_once(order: str, rng: np.random.Generator) -> None:
    left = lens("reg")
    right = left.with_parameters(np.asarray(left.parameters) + np.array([1.0, 1.0, 4.0, -3.0, *[0.0] * 5]))
    rotation, translation = poses(rng, 25, 0.4 * rng.normal(size=(25, 3)))
    beside = exp_so3(np.array([0.0, 0.05, 0.0]))
    views = prefixed(seen(left, rotation, translation, rng), "a")
    other = prefixed(seen(right, beside @ rotation, translation @ beside.T - [60.0, 0.0, 0.0], rng), "b")
    names = {view.image for view in (*views, *other)}
    both = [*views, *other]
    if order == "in turns":
        both.sort(key=lambda view: view.image[1:])
    result = calibrate(both, SIZE, model="brown", board="flat")
    assert "two cameras are mixed" in first(result) and len(names) > 20
    of_one = first(result).partition("of which one camera took ")[2]
    assert of_one.count("'a") > 9 > of_one.count("'b") == 0 or of_one.count("'b") > 9 > of_one.count("'a") == 0
    assert worst(result.verdicts) is Severity.BAD
    assert "mixed" not in str(calibrate(views, SIZE, model="brown", board="flat").verdicts)
    # Of 11 images and 3 of the same moments by the other camera, each pair has the same motion.
    also = {view.image[1:] for view in views[:11]} & {view.image[1:] for view in other}
    three = [view for view in other if view.image[1:] in sorted(also)[:3]]
    few = calibrate([*views[:11], *three], SIZE, model="brown", board="flat", folds=0)
    assert len(three) == 3 and "and in 2 other pairs of images" in first(few)


def test_a_board_moved_by_equal_steps_is_one_camera(rng: np.random.Generator) -> None:
    steps = np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2)
    rotation = exp_so3(np.tile([0.3, 0.2, 0.0], (20, 1)))
    centre = np.concatenate([110.0 * (steps - [2.0, 1.5]), np.full((20, 1), 900.0)], axis=1)
    views = seen(lens("reg"), rotation, centre - rotation @ BOARD.points().mean(axis=0), rng)
    assert "mixed" not in str(calibrate(views, SIZE, model="brown", board="flat").verdicts)


def test_a_robot_or_a_board_held_still_is_one_camera(rng: np.random.Generator) -> None:
    """Motions between the same two places come again with every tilt, and with every image of a still board."""
    places = np.array([[0.0, 0.0, 900.0], [160.0, 30.0, 950.0], [-120.0, 90.0, 1000.0], [60.0, -130.0, 850.0]])
    tilts = exp_so3(np.array([[0.0, 0.1, 0.0], [0.4, 0.2, 0.0], [-0.3, 0.3, 0.5]]))
    robot = np.tile(tilts, (4, 1, 1)), np.repeat(places, 3, axis=0)
    counts = [7, 7, 1, 1]
    still = exp_so3(0.001 * rng.normal(size=(16, 3))) @ np.repeat(
        exp_so3(0.3 * rng.normal(size=(4, 3))), counts, axis=0
    )
    held = still, np.repeat(places, counts, axis=0) + rng.normal(size=(16, 3))
    for rotation, centre in (robot, held):
        views = seen(lens("reg"), rotation, centre - rotation @ BOARD.points().mean(axis=0), rng)
        result = calibrate(views, SIZE, model="brown", board="flat", folds=0)
        assert len(result.views) == len(centre) and "mixed" not in str(result.verdicts)


@pytest.mark.parametrize("zoom", [0.0, 0.05], ids=["one camera", "two cameras"])
def test_two_places_with_equal_tilts_are_of_two_cameras_only_with_two_lenses(
    zoom: float, rng: np.random.Generator
) -> None:
    """Tilts about a point beside the board, as a robot's hand turns it."""
    tilts = exp_so3(np.array([[0.0, 0.1, 0.0], [0.4, 0.2, 0.0], [-0.3, 0.3, 0.5]]))
    middle = tilts @ np.array([60.0, -80.0, 100.0]) - tilts @ BOARD.points().mean(axis=0)
    one, other = lens("reg"), lens("reg")
    other = other.with_parameters(np.asarray(other.parameters) * np.array([*[1.0 + zoom] * 2, *[1.0] * 7]))
    views = []
    for name, camera, place in (("a", one, [-80.0, 0.0, 700.0]), ("b", other, [90.0, 40.0, 750.0])):
        views += prefixed(seen(camera, tilts, middle + np.array(place), rng), name)
    assert len(views) == 6
    found = str(calibrate(views, SIZE, model="brown", board="flat", folds=0).verdicts)
    assert ("mixed" in found) == (zoom > 0.0)


@pytest.mark.parametrize("count", [7, 40])
def test_boards_parallel_to_each_other(count: int, rng: np.random.Generator) -> None:
    """Said before seven images in place of eight."""
    about = np.array([0.5, 0.3, 0.0]) + 0.03 * rng.normal(size=(40, 3))
    views = seen(lens("reg"), *poses(rng, 40, about), rng)
    result = calibrate(views[:count], SIZE, model="brown", board="flat")
    assert "nearly parallel to each other" in first(result)
    assert ("only 7 images" in str(result.verdicts)) == (count == 7)


def test_boards_the_same_way_up(rng: np.random.Generator) -> None:
    tilts = np.concatenate([0.4 * rng.normal(size=(90, 2)), 0.02 * rng.normal(size=(90, 1))], axis=1)
    upright = calibrate(seen(lens("reg"), *poses(rng, 90, tilts), rng), SIZE, model="brown", board="flat")
    assert "never rotated in the image plane" in first(upright)
    tilts[::2, 2] += np.pi / 2.0
    turned = calibrate(seen(lens("reg"), *poses(rng, 90, tilts), rng), SIZE, model="brown", board="flat")
    assert turned.verdicts[0].severity is Severity.GOOD


def test_what_boards_the_same_way_up_leave_open(rng: np.random.Generator) -> None:
    tilts = np.concatenate([0.4 * rng.normal(size=(20, 2)), 0.02 * rng.normal(size=(20, 1))], axis=1)
    views = seen(lens("reg"), *poses(rng, 20, tilts), rng)
    assert "residuals of neighbouring corners are correlated" in first(
        calibrate(views, SIZE, model="pinhole", board="flat")
    )
    tilts[::2, 2] += np.pi / 2.0
    for own, provided in ((views, True), (seen(lens("reg"), *poses(rng, 20, tilts), rng), False)):
        longer = [replace(v, board=replace(v.board, square_x_mm=0.99 * v.board.square_x_mm)) for v in own]
        printed = str(calibrate(longer, SIZE, model="brown", board="warp").verdicts)
        assert "longer in x relative to y than declared" in printed and ("if pixels are square" in printed) == provided


def test_boards_at_one_distance(rng: np.random.Generator) -> None:
    rotation, translation = poses(rng, 60, 0.3 * rng.normal(size=(60, 3)))
    centre = translation + rotation @ BOARD.points().mean(axis=0)
    to_one = centre * (1500.0 / np.linalg.norm(centre, axis=1, keepdims=True) - 1.0)
    result = calibrate(seen(lens("reg"), rotation, translation + to_one, rng), SIZE, model="brown", board="flat")
    assert "all boards were at the same distance" in first(result)


def test_repeated_frames(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 10, rng, reach_deg=33.0, noise_px=NOISE_PX)
    again = [replace(v, image=f"again {v.image}", pixels=v.pixels + 0.01 * rng.normal(size=(54, 2))) for v in views]
    assert "show the board at the pose of another image" in first(calibrate([*views, *again], SIZE, model="brown"))
    # One of eleven is told, and is nothing to distrust the others for.
    alone = calibrate([*views, again[0]], SIZE, model="brown", board="flat")
    assert "at the pose of another image" not in first(alone)
    assert any("shows the board at the pose of another image" in str(verdict) for verdict in alone.verdicts)
    few = calibrate([*views[:4], *again[:4]], SIZE, model="brown", board="flat")
    assert "at the pose of another image" in first(few)
    assert any("8 images show only 4 different poses of the boards" in str(verdict) for verdict in few.verdicts)
    same = [replace(views[0], image=f"{k}", pixels=views[0].pixels + 0.05 * rng.normal(size=(54, 2))) for k in range(5)]
    one = calibrate(same, SIZE, model="brown", board="flat")
    assert any("5 images show a single pose of the boards" in str(verdict) for verdict in one.verdicts)


def test_corners_of_the_image_without_boards(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=15.0)
    result = calibrate(views, SIZE, model="brown", board="flat")
    assert "there the lens model is extrapolated" in first(result)


def test_few_images_are_the_cause_of_a_large_uncertainty(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 2, rng, reach_deg=33.0)
    result = calibrate(views, SIZE, board="flat")
    assert "only 2 images" in first(result) and "uncertain" in str(result.verdicts[1:])


def test_no_remedy_that_is_in_force(rng: np.random.Generator) -> None:
    x, y = (BOARD.points()[:, :2] / 120.0 - 1.0).T
    bent = BOARD.points()
    views = []
    for k, view in enumerate(random_views(lens("reg"), 14, rng, reach_deg=33.0)[0]):
        wave = np.stack([np.sin(4.0 * x + k), np.cos(3.0 * y - k)], axis=-1)
        views.append(replace(view, pixels=np.clip(view.pixels + 0.5 * wave, 0.0, np.array(SIZE) - 1.0)))
    assert len(bent) == len(views[0].grid)
    printed = str(calibrate(views, SIZE, model="auto", board="auto").verdicts)
    assert "neighbouring corners are correlated" in printed and '"auto"' not in printed
    assert 'board_shape = "auto"' in str(calibrate(views, SIZE, model="auto", board="flat").verdicts)
    assert 'model = "auto"' in str(calibrate(views, SIZE, model="brown", board="auto").verdicts)


def test_frames_that_are_not_of_one_moment(rng: np.random.Generator) -> None:
    left, right = lens("reg"), lens("reg", np.array([790.0, 640.0]))
    rotation, translation = poses(rng, 40, 0.4 * rng.normal(size=(40, 3)))
    late = exp_so3(0.002 * rng.normal(size=(40, 3)))
    views = {
        "left": [(view.image, view) for view in seen(left, rotation, translation, rng)],
        "right": [
            (view.image, view)
            for view in seen(right, late @ rotation, translation + 0.5 * rng.normal(size=(40, 3)) - [80.0, 0, 0], rng)
        ],
    }
    rig = calibrate_rig(views, {"left": SIZE, "right": SIZE}, model="brown")
    assert rig.verdicts[0].severity is not Severity.GOOD
    assert "the images of a frame are not simultaneous" in rig.verdicts[0].message
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        # Within what the camera alone knows.
        found = compare_cameras(alone.camera, camera.calibration.camera)
        assert found.rms_px < 1.0
        assert (camera.calibration.parameter_sigmas > 0.5 * alone.parameter_sigmas).all()


@pytest.mark.parametrize("other_mm", [30.0, 25.0])
def test_boards_whose_stated_sizes_contradict_each_other(other_mm: float, rng: np.random.Generator) -> None:
    """Both are of 30 mm. One camera cannot tell; two see themselves nearer to each other by the one that is stated
    with 25 mm."""
    cameras = {"left": (lens("reg"), 0.0), "right": (lens("reg", np.array([790.0, 640.0])), -80.0)}
    rotation, translation = poses(rng, 40, 0.4 * rng.normal(size=(40, 3)))
    sizes = {"first": 30.0, "second": other_mm}
    stated = [replace(BOARD, board_id=name, square_x_mm=mm, square_y_mm=mm) for name, mm in sizes.items()]
    views = {
        name: [
            (view.image, replace(view, board=stated[int(view.image[:3]) % 2]))
            for view in seen(camera, rotation, translation + np.array([away, 0.0, 0.0]), rng)
        ]
        for name, (camera, away) in cameras.items()
    }
    rig = calibrate_rig(views, dict.fromkeys(cameras, SIZE), model="brown")
    assert ("are inconsistent" in rig.verdicts[0].message) is (other_mm != 30.0)
    assert "the images of a frame are not simultaneous" not in str(rig.verdicts)


def test_the_verdict_does_not_depend_on_how_the_model_was_reached(rng: np.random.Generator) -> None:
    fish = lens("fish")
    longer = fish.with_parameters(np.asarray(fish.parameters) * np.array([1.03, 1.03, *[1.0] * 6]))
    views, _, _ = random_views(fish, 12, rng, reach_deg=85.0, noise_px=NOISE_PX)
    later, _, _ = random_views(longer, 12, rng, reach_deg=85.0, noise_px=NOISE_PX)
    together = [*prefixed(views, "a"), *prefixed(later, "b")]
    chosen = calibrate(together, SIZE, model="auto", board="flat")
    named = calibrate(together, SIZE, model=chosen.camera.model, board="flat")
    assert (chosen.camera.parameters == named.camera.parameters).all()
    # How far other models go apart where no board was is known with "auto" alone, and part of the numbers.
    number = re.compile(r"[0-9.]+")
    words = [[(v.severity, number.sub("", v.message)) for v in one.verdicts] for one in (chosen, named)]
    assert words[0] == words[1]
    assert "the lens (or the board) changed at image" in str(chosen.verdicts[0])
    tried = {candidate.name.split()[0] for candidate in chosen.candidates}
    assert {"pinhole", "brown", "kannala_brandt", "scaramuzza"} <= tried
    assert [c.chosen for c in chosen.candidates if "pupil" not in c.name].count(True) == 1


def test_images_with_two_kinds_of_names_are_of_two_cameras(rng: np.random.Generator) -> None:
    left = lens("reg")
    right = left.with_parameters(np.asarray(left.parameters) * np.array([1.03, 1.03, *[1.0] * 7]))
    views = prefixed(random_views(left, 12, rng, reach_deg=33.0)[0], "left")
    other = prefixed(random_views(right, 12, rng, reach_deg=33.0)[0], "right")
    in_turns = [view for pair in zip(views, other, strict=True) for view in pair]
    mixed = calibrate(in_turns, SIZE, model="brown", board="flat")
    assert "those named like 'left000.png' and like 'right000.png'" in first(mixed)
    two_names = [replace(v, image=f"{'a' if k % 2 else 'b'}{v.image}") for k, v in enumerate(views)]
    assert "mixed" not in str(calibrate(two_names, SIZE, model="brown", board="flat").verdicts)


def test_one_image_many_times_is_named(rng: np.random.Generator) -> None:
    views, *_ = random_views(lens("reg"), 1, rng, reach_deg=30.0)
    again = [replace(views[0], image=f"{k:02d}.png") for k in range(12)]
    with pytest.raises(DegenerateError, match="all 12 images show the board at the same pose"):
        calibrate(again, SIZE)
