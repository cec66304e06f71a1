"""The result of a calibration does not depend on the order of its images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.diagnosis.moved import two_cameras
from rigkit.calibration.views.repeats import cluster_numbers, folds_of
from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

FOLDS = 5
SAME = 1e-6
"""Sums of other orders round otherwise; solvers stop within this."""
UNSURE_MM = 1.0
"""By so much boards' places are off: where two of a motion then agree is chance."""


@pytest.mark.parametrize(("name", "seed"), [("fish", 7), ("wide", 1)])
def test_shuffled_images_have_the_same_lens(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    views, *_ = random_views(lens(name), 12, rng, reach_deg=REACH_DEG[name])
    found = [calibrate([views[k] for k in order], SIZE) for order in (range(12), *(rng.permutation(12) for _ in "ab"))]
    for other in found[1:]:
        assert len(other.camera.parameters) == len(found[0].camera.parameters)
        assert [board.kind for board in other.boards] == [board.kind for board in found[0].boards]
        assert other.heldout_rms_px == pytest.approx(found[0].heldout_rms_px, rel=SAME)
        rays, _ = found[0].camera.unproject(np.concatenate([view.pixels for view in views]))
        assert np.abs(other.camera.project(rays)[0] - found[0].camera.project(rays)[0]).max() < SAME
        typical = FarProjection.of(found[0], from_boards=True).typical_px
        assert FarProjection.of(other, from_boards=True).typical_px == pytest.approx(typical, rel=1e-3)


def boards_at(centres: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
    """Return corners (54, 2) px of boards of a like size around each of the centres (N, 2) px."""
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2) - [4.0, 2.5]
    slants = np.eye(2) + 0.2 * rng.normal(size=(len(centres), 2, 2))
    return [centre + 30.0 * grid @ slant for centre, slant in zip(centres, slants, strict=True)]


def test_folds_are_the_same_in_any_order(rng: np.random.Generator) -> None:
    pixels = boards_at(rng.uniform(300.0, 900.0, (23, 2)), rng)
    order = rng.permutation(23)
    folds = folds_of(pixels, np.arange(23), FOLDS)
    assert np.array_equal(folds_of([pixels[k] for k in order], np.arange(23), FOLDS), folds[order])
    assert sorted(np.bincount(folds)) == [4, 4, 5, 5, 5]


def test_every_fold_has_boards_on_all_sides(rng: np.random.Generator) -> None:
    # Boards left, right, above and below, five of each: chance leaves a side out of one of five folds nearly always.
    sides = np.repeat([[200.0, 600.0], [1400.0, 600.0], [800.0, 200.0], [800.0, 1000.0]], FOLDS, axis=0)
    off = []
    for _ in range(20):
        pixels = boards_at(sides + rng.normal(size=sides.shape) * 20.0, rng)
        fold = folds_of(pixels, np.arange(20), FOLDS)
        middle = np.array([sides[fold == k].mean(axis=0) for k in range(FOLDS)])
        off.append(np.sqrt(((middle - sides.mean(axis=0)) ** 2).sum(axis=1).mean()))
    # By chance the middles of folds of 4 are 245 px rms from that of all.
    assert np.mean(off) < 100.0


def test_images_that_nearly_repeat_each_other_are_left_out_together(rng: np.random.Generator) -> None:
    places = boards_at(rng.uniform(300.0, 900.0, (10, 2)), rng)
    pixels = [one + shift for one in places for shift in (0.0, 1.5)]
    fold = folds_of(pixels, np.arange(20), FOLDS)
    assert np.array_equal(fold[::2], fold[1::2])
    assert np.bincount(fold).tolist() == [4] * FOLDS
    # A film in which the board never stops is one chain, and no fold.
    film = [places[0] + 1.5 * k for k in range(40)]
    assert np.bincount(folds_of(film, np.arange(40), FOLDS)).max() <= 8


def test_images_that_repeat_others_are_one_in_any_order(rng: np.random.Generator) -> None:
    board = boards_at(np.array([[500.0, 500.0]]), rng)[0]
    pixels = [board, board + 0.4, board + 0.8, board + 5.0]
    for order in ([0, 1, 2, 3], [2, 0, 1, 3], [0, 2, 3, 1]):
        number = cluster_numbers([str(k) for k in order], ["b"] * 4, [pixels[k] for k in order])
        assert len({int(number[order.index(k)]) for k in (0, 1, 2)}) == 1
        assert number[order.index(3)] != number[order.index(0)]


def test_two_cameras_are_found_or_not_in_any_order() -> None:
    """Poses so unsure that a motion hardly comes twice, of more images than motions are tried from."""
    rng = np.random.default_rng(15)
    views, rotations, places = random_views(lens("reg"), 30, rng, reach_deg=REACH_DEG["reg"])
    found = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    beside = exp_so3(np.array([0.0, 0.05, 0.0]))
    both = []
    for k, view in enumerate(found.views):
        own = np.array([places[k], beside @ places[k] - [60.0, 0.0, 0.0]]) + rng.normal(size=(2, 3)) * UNSURE_MM
        for name, turn, place in zip("ab", (rotations[k], beside @ rotations[k]), own, strict=True):
            both.append(replace(view, image=name + view.image, cam_from_board=Rigid3(turn, place)))
    printed = set()
    for _ in range(20):
        session = replace(found, views=tuple(both[k] for k in rng.permutation(len(both))))
        printed.add(bool(list(two_cameras(session, np.arange(len(both))))))
    assert len(printed) == 1
