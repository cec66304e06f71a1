"""The kernel of the fit of whole tags against pictures sampled from its model."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference.tags import picture

from rigkit.detection.tags.whole_tags import WHOLE_ROUNDS, WHOLE_RULES
from rigkit.kernels.tags import TagsToFit, fit_tags

SERIES_PX = 8e-3
"""Moves of 0.1 px turn and stretch edges, whose blur keeps its width; sampled pictures have steps of 0.06 px."""

MODULES = np.array([[1, 1, 1, 1, 1], [1, 0, 1, 0, 1], [1, 0, 0, 1, 1], [1, 1, 0, 0, 1], [1, 1, 1, 1, 1]], np.bool_)
BREAKS = np.array([-0.4, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.4])
CENTRE, SCALE = np.array([20.4, 19.7]), 8.0
MOVES = np.array([[0.12, -0.08], [-0.1, 0.04], [0.02, 0.08], [-0.04, -0.12]])
BENT = 0.02 * np.array([[1.0, -0.5, 0.8, 0.3, 0.2, -0.3, 0.1], [-0.6, 0.9, 0.4, -0.2, 0.3, 0.1, -0.3]])
SHAPES = {"straight": (0.0, 0.0), "aslant": (0.35, -0.1), "bent": (0.2, 0.3)}


def projected(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the polynomials of a tag some 12 px wide, and the ink of it, of tags beside and squares between."""
    shear, turn = SHAPES[name]
    linear = np.linalg.inv(np.array([[0.75, shear], [turn, 0.75]]))
    maps = np.concatenate([np.full((2, 1), 0.5), 0.5 * linear, (name == "bent") * BENT], axis=1)
    ink = np.zeros((9, 9), np.bool_)
    ink[2:-2, 2:-2] = MODULES
    ink[[0, -1], 2:-2] = ink[2:-2, -1] = True
    ink[[1, 1, -2, -2], [1, -2, 1, -2]] = True
    return maps, ink


def start(maps: np.ndarray, ink: np.ndarray, *, blur_px: float = 0.8, contrast: float = 120.0) -> TagsToFit:
    """Return one tag with what its fit starts from."""
    given = maps[None], CENTRE[None], np.array([SCALE]), ink[None], BREAKS, 0.2
    return TagsToFit(*given, np.array([blur_px]), np.array([contrast]), np.array([1e-3]))


@pytest.mark.parametrize("blur_px", [0.5, 0.76, 1.0])
@pytest.mark.parametrize("name", SHAPES)
def test_a_picture_of_the_model_gives_its_numbers_back(name: str, blur_px: float) -> None:
    maps, ink = projected(name)
    image = picture((42, 40), maps, CENTRE, SCALE, MOVES, ink, BREAKS, blur_px, 190.0, 160.0).astype(np.float32)
    found = fit_tags(image, start(maps, ink), WHOLE_RULES)[0]
    assert found[15] == 1.0
    assert np.abs(found[:8].reshape(4, 2) - MOVES).max() < SERIES_PX
    assert found[12] == pytest.approx(blur_px, abs=0.02)
    assert found[13] == pytest.approx(160.0, rel=0.01)


def test_sigmas_are_those_of_the_errors(rng: np.random.Generator) -> None:
    maps, ink = projected("bent")
    clean = picture((42, 40), maps, CENTRE, SCALE, MOVES, ink, BREAKS, 0.76, 190.0, 160.0)
    off = []
    for _ in range(100):
        image = (clean + rng.normal(0.0, 4.0, clean.shape)).astype(np.float32)
        found = fit_tags(image, start(maps, ink), WHOLE_RULES)[0]
        off.append((found[:8].reshape(4, 2) - MOVES) / found[8:12, None])
    # 800 numbers: 5 per cent are two standard deviations.
    assert 0.95 < np.sqrt(np.mean(np.square(off))) < 1.08


def test_what_is_left_is_noise_where_corners_were_right_from_the_start(rng: np.random.Generator) -> None:
    """Then the first step moves nothing, and the light is not fitted yet."""
    maps, ink = projected("straight")
    image = picture((42, 40), maps, CENTRE, SCALE, np.zeros((4, 2)), ink, BREAKS, 0.76, 190.0, 160.0)
    noisy = (image + rng.normal(0.0, 2.0, image.shape)).astype(np.float32)
    found = fit_tags(noisy, start(maps, ink, blur_px=0.76, contrast=160.0), WHOLE_ROUNDS[0])[0]
    # 250 pixels: their rms is known to a twentieth.
    assert found[14] == pytest.approx(2.0, rel=0.15)


def test_a_tag_outside_the_image_is_not_valid() -> None:
    maps, ink = projected("straight")
    image = np.full((40, 42), 100.0, np.float32)
    centres = np.array([[-60.0, 10.0], [np.nan, 10.0], [20.0, 20.0]])
    three = np.repeat(maps[None], 3, axis=0), centres, np.full(3, SCALE), np.repeat(ink[None], 3, axis=0), BREAKS, 0.2
    tags = TagsToFit(*three, np.full(3, 0.8), np.full(3, 120.0), np.full(3, 0.01))
    found = fit_tags(image, tags, WHOLE_RULES)
    assert not found[:2, 15].any()
    # Of even paper nothing says where corners are.
    assert found[2, 15] == 0.0 or found[2, 13] == pytest.approx(0.0, abs=1.0)
