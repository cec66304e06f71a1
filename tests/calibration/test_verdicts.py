"""Verdicts: each fault that was put into the views is named, and sound views get none of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.calibration_scenes import BOARD, SIZE, lens, random_views

from rigkit.boards import Board
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration


def said(result: Calibration, words: str) -> bool:
    return any(words in verdict for verdict in result.verdicts)


def test_sound_views_are_called_good(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0)
    result = calibrate(views, SIZE, model="brown")
    assert result.verdicts[0].startswith("good: held-out RMS")
    assert not any(v.startswith("bad") for v in result.verdicts)
    assert not said(result, "neighbouring") and not said(result, "unlike") and not said(result, "retake")


def test_too_few_tilts_and_empty_corners(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 12, rng, reach_deg=15.0, tilt_deg=(0.0, 8.0))
    result = calibrate(views, SIZE, model="brown", board="flat")
    assert said(result, "tilted by more than") and result.verdicts[0].startswith("bad")
    assert said(result, "no corners in the top left")


def test_moved_lens(rng: np.random.Generator) -> None:
    first = lens("reg")
    second = first.with_parameters(first.parameters * np.array([1.02, 1.02, *[1.0] * 7]))
    views, _, _ = random_views(first, 10, rng, reach_deg=33.0)
    later, _, _ = random_views(second, 10, rng, reach_deg=33.0)
    views += [replace(v, image=f"later{v.image}") for v in later]
    assert said(calibrate(views, SIZE, model="brown", board="flat"), "from 'later000.png' on")


def test_wrong_aspect_and_bent_board(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0, points_mm=Board("b", 9, 6, 30.2, 30.0).points())
    assert said(calibrate(views, SIZE, model="brown", board="warp"), "longer along its columns")
    bent = BOARD.points()
    bent[:, 2] = 2.0 * (1.0 - ((bent[:, 0] - 120.0) / 120.0) ** 2)
    views, _, _ = random_views(lens("reg"), 20, rng, reach_deg=33.0, points_mm=bent)
    flat = calibrate(views, SIZE, model="brown", board="flat")
    assert said(flat, "neighbouring corners agree")
    shaped = calibrate(views, SIZE, model="brown")
    assert shaped.boards[0].kind != "flat" and said(shaped, "departs from a plane")
    assert not said(shaped, "neighbouring corners agree")


def test_few_images_and_one_bad_view(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 6, rng, reach_deg=33.0)
    shaken = replace(views[2], pixels=views[2].pixels + 0.8 * rng.normal(size=(54, 2)))
    result = calibrate([*views[:2], shaken, *views[3:]], SIZE, model="brown", board="flat")
    assert said(result, "6 images") and said(result, "'002.png' has a median residual")
