"""What changes from image to image is named, and what is wrong in all images alike is no change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.diagnosis.changing import CHANGES, MIN_NEIGHBOUR_CORRELATION, changing
from rigkit.calibration.diagnosis.verdicts import diagnose
from rigkit.calibration.diagnosis.view_evidence import view_evidence
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.detections import BoardView
from rigkit.core.findings import Severity


def changed_views(way: str, rng: np.random.Generator) -> list[BoardView]:
    """Return 20 views of which each is seen by the same lens but for what changes from image to image."""
    camera, side = lens("reg"), BOARD.grid() / (np.array(BOARD.size) - 1.0) * 2.0 - 1.0
    out = []
    for k in range(20):
        own, points = camera, BOARD.points()
        if way == "focus":
            own = camera.with_parameters(camera.parameters * np.array([*[1.0 + 0.01 * rng.normal()] * 2, *[1.0] * 7]))
        if way == "bend":
            bow = rng.normal(size=2)
            points[:, 2] += bow[0] * (1.0 - side[:, 0] ** 2) + bow[1] * side[:, 0] * side[:, 1]
        view = random_views(own, 1, rng, reach_deg=33.0, noise_px=0.05, points_mm=points)[0][0]
        pixels = np.array(view.pixels)
        if way == "shift":
            pixels += 12.0 * rng.normal(size=2)
        if way == "rows":
            velocity, spin = 2.0 * rng.normal(size=2), 0.005 * rng.normal()
            off = pixels - pixels.mean(axis=0)
            pixels += pixels[:, 1:] / SIZE[1] * (velocity + spin * off[:, ::-1] * [-1.0, 1.0])
        pixels = np.clip(pixels, -0.5, np.array(SIZE) - 0.5)
        out.append(replace(view, image=f"{k:03d}.png", pixels=pixels))
    return out


@pytest.mark.parametrize(
    ("way", "words"),
    [
        ("focus", "the focal length differs from image to image"),
        ("shift", "the principal point differs from image to image"),
        ("rows", "motion with a rolling shutter"),
        ("bend", "the board bends differently in every image"),
    ],
)
def test_what_changes_from_image_to_image(way: str, words: str, rng: np.random.Generator) -> None:
    """In most sessions; where two kinds of change follow the images nearly as well, nothing is said rather than the
    wrong one."""
    results = [calibrate(changed_views(way, rng), SIZE, model="brown", board="flat") for _ in range(4)]
    named = [result for result in results if changing(result)]
    assert len(named) >= 3
    assert all(words in str(result.verdicts) for result in named), [str(result.verdicts[0]) for result in named]


def test_a_zoom_beneath_noise_is_named(rng: np.random.Generator) -> None:
    """It explains less than half of the squares, but for each degree of freedom far more than what is no change of the
    lens."""
    views = [
        replace(view, pixels=np.clip(view.pixels + 0.2 * rng.normal(size=view.pixels.shape), 0.0, np.array(SIZE) - 1.0))
        for view in changed_views("focus", rng)
    ]
    found = changing(calibrate(views, SIZE, model="brown", board="flat", folds=0))
    assert [CHANGES["focus"].message in finding.message for finding in found] == [True]


@pytest.mark.parametrize(
    "how",
    [
        pytest.param({"model": "brown", "board": "flat", "folds": 0}, id="brown"),
        pytest.param({}, id="default", marks=pytest.mark.thorough),
    ],
)
def test_boards_in_hand_that_move_while_rows_are_read(how: dict[str, Any], rng: np.random.Generator) -> None:
    """Moved by 3 to 24 px, poses and the lens follow so much of it that columns fit nearly as well as rows: it is named
    all the same, and never something else."""
    camera, named = Pinhole(SIZE, np.array([1364.0, 1364.0, 815.0, 617.0])), 0
    for _ in range(8):
        views = []
        for view, turn, shift in zip(*random_views(camera, 14, rng, reach_deg=30.0, tilt_deg=(0.0, 35.0)), strict=True):
            points, pixels = BOARD.points() @ turn.T + shift, view.pixels
            way = rng.uniform(0.0, 2.0 * np.pi)
            move = rng.uniform(3.0, 24.0) * shift[2] / 1364.0 * np.array([np.cos(way), np.sin(way), 0.0])
            for _ in range(8):
                pixels, _ = camera.project(points + (pixels[:, 1:] / SIZE[1] - 0.5) * move)
            noisy = np.clip(pixels + 0.02 * rng.normal(size=pixels.shape), -0.5, np.array(SIZE) - 0.5)
            views.append(replace(view, pixels=noisy))
        found = changing(calibrate(views, SIZE, **how))
        assert all("rolling shutter" in finding.message for finding in found)
        named += len(found)
    assert named >= 7


def test_images_that_contradict_each_other_come_before_what_that_does_to_the_lens(rng: np.random.Generator) -> None:
    """More of such images would not make it surer."""
    views = []
    for view in random_views(lens("reg"), 12, rng, reach_deg=18.0, noise_px=0.05)[0]:
        bent = view.pixels + 1.5 * np.sin(view.pixels / 120.0 + rng.uniform(0.0, 6.0, 2))
        views.append(replace(view, pixels=np.clip(bent, -0.5, np.array(SIZE) - 0.5)))
    result = calibrate(views, SIZE, model="brown", board="flat")
    headline, *others = diagnose(result, in_force=("model", "board_shape"))
    assert headline.severity is Severity.BAD
    assert "so something changes between images" in headline.message
    assert any("the projection uncertainty" in finding.message for finding in others)


def test_a_sheared_picture_is_told_from_a_shifted_one_by_nobody(rng: np.random.Generator) -> None:
    """As by a camera that is swung aside while rows are read: both are named (by shifts alone in 10 of 10 draws)."""
    camera = Pinhole(SIZE, np.array([1364.0, 1364.0, 815.0, 617.0]))
    views = []
    for view in random_views(camera, 14, rng, reach_deg=30.0, noise_px=0.03)[0]:
        pixels = view.pixels.copy()
        pixels[:, 0] += 4.0 * rng.uniform(-1.0, 1.0) * (pixels[:, 1] / SIZE[1] - 0.5)
        views.append(replace(view, pixels=np.clip(pixels, -0.5, np.array(SIZE) - 0.5)))
    found = changing(calibrate(views, SIZE, model="brown", board="flat", folds=0))
    assert [finding.message.split(":")[0] for finding in found] == [
        "the principal point differs from image to image (stabilisation, cropping, or images of another camera), or "
        "images are sheared by a rolling shutter"
    ]
    assert found[0].remedy is not None and "still" in found[0].remedy


@pytest.mark.parametrize("again", ["in half of the images", "in each image"])
def test_a_zoom_is_not_taken_for_a_motion(again: str, rng: np.random.Generator) -> None:
    """Half of the images at a focal length 1 % longer, or each at its own, before a board that is bent a little."""
    bent, side = BOARD.points(), BOARD.grid() / (np.array(BOARD.size) - 1.0) * 2.0 - 1.0
    bent[:, 2] += 0.4 * (1.0 - side[:, 0] ** 2) + 0.1 * side[:, 0] * side[:, 1]
    camera, named = lens("reg"), 0
    for _ in range(4):
        views = []
        for k in range(20):
            longer = 1.0 + (rng.uniform(0.0, 0.03) if again == "in each image" else 0.01 * (k % 2))
            own = camera.with_parameters(camera.parameters * np.array([longer, longer, *[1.0] * 7]))
            view = random_views(own, 1, rng, reach_deg=33.0, noise_px=0.03, points_mm=bent)[0][0]
            views.append(replace(view, image=f"{k:03d}.png"))
        found = calibrate(views, SIZE, model="brown", folds=0)
        reported = str(found.verdicts)
        assert (
            "rolling shutter" not in reported
            and "bends differently" not in reported
            and "principal point differs" not in reported
        )
        named += "the focal length differs from image to image" in reported or "(focal lengths " in reported
    assert named >= 3


@pytest.mark.parametrize("way", ["focus", "shift", "rows", "bend"])
def test_what_changes_is_far_above_the_correlation_that_is_looked_at(way: str, rng: np.random.Generator) -> None:
    result = calibrate(changed_views(way, rng), SIZE, model="brown", board="flat")
    assert result.corners.neighbour_correlation > 3.0 * MIN_NEIGHBOUR_CORRELATION
    # Mere noise is not looked at: nothing would be found there.
    noise = calibrate(changed_views("nothing", rng), SIZE, model="brown", board="flat")
    assert noise.corners.neighbour_correlation < MIN_NEIGHBOUR_CORRELATION
    evidence = view_evidence(noise)
    assert evidence is not None
    assert max(change.share for change in evidence.changes.values()) < 0.1


def test_what_is_wrong_in_all_images_alike_changes_in_none(rng: np.random.Generator) -> None:
    """A lens of another kind than the model, and a bent board, are no change from image to image."""
    same = changed_views("nothing", rng)
    assert changing(calibrate(same, SIZE, model="brown", board="flat")) == []
    assert changing(calibrate(same, SIZE, model="ucm", board="flat")) == []
    bent = BOARD.points()
    bent[:, 2] += 1.5 * (1.0 - (BOARD.grid()[:, 0] / 4.0 - 1.0) ** 2)
    views = random_views(lens("reg"), 20, rng, reach_deg=33.0, noise_px=0.05, points_mm=bent)[0]
    for shape in ("flat", "warp"):
        assert changing(calibrate(views, SIZE, model="brown", board=shape)) == []


def test_a_window_before_the_lens_is_no_change_between_images(rng: np.random.Generator) -> None:
    """It shears every board a little, as a rolling shutter does; but images left out are predicted."""
    views = []
    for view in random_views(lens("reg"), 20, rng, reach_deg=30.0, noise_px=0.02)[0]:
        u, v = view.pixels.T / SIZE[0]
        window = 2.0 * np.stack([np.sin(3.0 * v + 2.0 * u), np.cos(2.5 * u - v)], axis=-1)
        views.append(replace(view, pixels=np.clip(view.pixels + window, -0.5, np.array(SIZE) - 0.5)))
    result = calibrate(views, SIZE, model="brown", board="flat")
    found = str(diagnose(result, in_force=("model", "board_shape")))
    assert "one smooth distortion, the same in all images" in found
    assert "rolling" not in found and "changes between images" not in found


def test_a_lens_beyond_all_numbers_tells_nothing_of_what_changes(rng: np.random.Generator) -> None:
    result = calibrate(changed_views("rows", rng), SIZE, model="brown", board="flat")
    parameters = np.array(result.camera.parameters)
    parameters[4] = -9e14
    assert changing(result) != []
    assert changing(replace(result, camera=result.camera.with_parameters(parameters))) == []
