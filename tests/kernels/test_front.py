"""The kernels of corner candidates against numpy and OpenCV: the same corners and links, up to rounding."""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from helpers.detection_scenes import corner_scene, fisheye, printed_text, regular
from helpers.opencv import exact_interpolation
from helpers.real_images import real_images
from kernels.reference import front as reference
from kernels.reference import links as linked

from rigkit.detection.lattice import links
from rigkit.detection.lattice.links import find_links
from rigkit.detection.saddles import response, saddle
from rigkit.detection.saddles.response import Level, grey_image, peaks, pyramid
from rigkit.detection.saddles.saddle import Corners, find_corners
from rigkit.kernels import front

SMOOTH_LEVELS = 1e-4
"""Sums of 25 single-precision products of grey levels."""

ANGLE_RAD = 1e-3
"""Where a ring crosses half its contrast with next to no slope, rounding moves the crossing."""

SAME_SHARE = 0.998
"""Tests against a bound may fall the other way by rounding; in noise a few of thousands do."""


@functools.cache
def _images() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    images = {
        "boards": corner_scene(rng, regular(), 1250.0).image(rng),
        "fisheye": corner_scene(rng, fisheye(), 480.0).image(rng, noise_levels=6.0),
        "noise": (rng.random((301, 403)) * 255).astype(np.uint8),
        "small": (rng.random((17, 16)) * 255).astype(np.uint8),
        "text": printed_text(),
        "black": np.zeros((60, 80), np.uint8),
        **real_images(),
    }
    assert tuple(images) == NAMES
    return images


NAMES = ("boards", "fisheye", "noise", "small", "text", "black", *real_images())


@pytest.fixture
def in_numpy(monkeypatch: pytest.MonkeyPatch) -> Callable[..., object]:
    def run(function: Callable[..., object], *args: object) -> object:
        with monkeypatch.context() as patch:
            for name in ("shrunk", "level", "peaks", "corners", "near_any"):
                patch.setattr(front, name, getattr(reference, name))
            patch.setattr(front, "links", linked.links)
            return function(*args)

    return run


@pytest.mark.parametrize("depth", [np.uint8, np.float32])
@pytest.mark.parametrize("name", NAMES)
def test_levels(name: str, depth: type, in_numpy: Callable[..., list[Level]]) -> None:
    grey = grey_image(_images()[name].astype(depth))
    assert grey.dtype == depth
    for ours, theirs in zip(pyramid(grey), in_numpy(pyramid, grey), strict=True):
        assert ours.smooth.shape == theirs.smooth.shape
        assert np.abs(ours.smooth - theirs.smooth).max() < SMOOTH_LEVELS
        assert ours.thresholds == pytest.approx(theirs.thresholds, rel=1e-3, abs=1e-6)
        assert (ours.scale, ours.offset) == (theirs.scale, theirs.offset)


@pytest.mark.parametrize("reach", [0.0, 0.3, 5.0, 1e4])
def test_near_any(reach: float, rng: np.random.Generator) -> None:
    known = rng.uniform(0.0, 500.0, (200, 2))
    fresh = np.concatenate([known[::9], rng.uniform(-50.0, 550.0, (300, 2))])
    assert np.array_equal(front.near_any(fresh, known, reach), reference.near_any(fresh, known, reach))


@pytest.mark.parametrize("depth", [np.uint8, np.float32])
@pytest.mark.parametrize("factor", [2, 4, 8])
def test_shrinking(factor: int, depth: type, rng: np.random.Generator, in_numpy: Callable[..., np.ndarray]) -> None:
    image: np.ndarray = (rng.random((67, 85)) * 256).astype(depth)
    ours, theirs = response._shrunk(image, factor), in_numpy(response._shrunk, image, factor)
    assert ours.shape == theirs.shape == (67 // factor, 85 // factor)
    assert np.abs(ours - theirs).max() < SMOOTH_LEVELS


def test_the_brightest_bytes_overflow_nothing() -> None:
    white = np.full((600, 530), 255, np.uint8)
    assert (pyramid(white)[0].smooth == 255.0).all()
    for factor in (2, 3, 6, 16, 256, 260):
        assert np.abs(response._shrunk(white, factor) - 255.0).max() < SMOOTH_LEVELS


@pytest.mark.parametrize("name", NAMES)
def test_peaks(name: str, in_numpy: Callable[..., tuple[np.ndarray, np.ndarray]]) -> None:
    for level in pyramid(grey_image(_images()[name])):
        (ours, height), (theirs, _) = peaks(level), in_numpy(peaks, level)
        assert (height > reference.threshold_at(level.thresholds, *ours.T)).all()
        both = len({tuple(p) for p in ours} & {tuple(p) for p in theirs})
        assert both >= SAME_SHARE * max(len(ours), len(theirs))


def test_equal_neighbours_make_one_peak(in_numpy: Callable[..., np.ndarray]) -> None:
    board = (((np.arange(240) // 24)[:, None] + np.arange(312) // 24) % 2 * 128 + 64).astype(np.uint8)
    level = pyramid(grey_image(board))[0]
    ours, _ = peaks(level)
    assert np.array_equal(ours, in_numpy(peaks, level)[0])
    assert len(ours) == 9 * 12


def test_no_more_peaks_than_asked(monkeypatch: pytest.MonkeyPatch, in_numpy: Callable[..., np.ndarray]) -> None:
    monkeypatch.setattr(response, "MAX_PEAKS", 400)
    monkeypatch.setattr(response, "PIXELS_A_PEAK", 10**4)
    level = pyramid(grey_image(_images()["noise"]))[0]
    (ours, height), (theirs, _) = peaks(level), in_numpy(peaks, level)
    assert 400 <= len(ours) == len(height) < 440
    assert (height > reference.threshold_at(level.thresholds, *ours.T)).all()
    assert np.array_equal(ours, theirs)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_peaks_beyond_float32_are_the_strongest(
    monkeypatch: pytest.MonkeyPatch, in_numpy: Callable[..., np.ndarray]
) -> None:
    image = _images()["noise"].astype(np.float32)
    image[20::97, 20::97] = 1e30
    level = pyramid(grey_image(image))[0]
    for found in (peaks, lambda level: in_numpy(peaks, level)):
        everything = found(level)
        with monkeypatch.context() as patch:
            patch.setattr(response, "MAX_PEAKS", 100)
            patch.setattr(response, "PIXELS_A_PEAK", 10**4)
            fewer = found(level)
        assert len(fewer[0]) < len(everything[0])
        infinite = [at[np.isinf(height)] for at, height in (everything, fewer)]
        assert len(infinite[0]) > 0
        assert np.array_equal(infinite[0], infinite[1])


@exact_interpolation
@pytest.mark.parametrize("name", NAMES)
def test_corners(name: str, in_numpy: Callable[..., tuple[Corners, saddle.Saddles]]) -> None:
    levels = pyramid(grey_image(_images()[name]))
    (ours, all_ours), (theirs, all_theirs) = find_corners(levels), in_numpy(find_corners, levels)
    assert abs(len(all_ours.pixels) - len(all_theirs.pixels)) <= (1.0 - SAME_SHARE) * len(all_ours.pixels)
    mine = {(*np.round(p, 3), s): k for k, (p, s) in enumerate(zip(ours.pixels, ours.scale, strict=True))}
    yours = {(*np.round(p, 3), s): k for k, (p, s) in enumerate(zip(theirs.pixels, theirs.scale, strict=True))}
    both = sorted(mine.keys() & yours.keys())
    assert len(both) >= SAME_SHARE * max(len(ours), len(theirs))
    if name in ("boards", "fisheye"):
        assert len(both) >= 144
    if not both:
        return
    one, two = [mine[key] for key in both], [yours[key] for key in both]
    turn = np.abs(ours.angles[one] - theirs.angles[two])
    assert np.minimum(turn, np.abs(np.pi - turn)).max() < ANGLE_RAD
    assert np.abs(ours.contrast[one] - theirs.contrast[two]).max() < 1e-3


@pytest.mark.parametrize("name", ["boards", "fisheye", "noise", "text"])
def test_links(name: str, in_numpy: Callable[..., links.Links]) -> None:
    levels = pyramid(grey_image(_images()[name]))
    corners, _ = find_corners(levels)
    ours, theirs = find_links(corners, levels[0]), in_numpy(find_links, corners, levels[0])
    same = (ours.corner == theirs.corner) & (ours.arm == theirs.arm)
    assert same.mean() >= SAME_SHARE
    if name in ("boards", "fisheye"):
        assert same.all()
        assert (ours.corner >= 0).sum() >= 3 * 2 * (7 * 6 + 8 * 5)


def test_links_of_a_crowd(rng: np.random.Generator, in_numpy: Callable[..., links.Links]) -> None:
    """Corners at random, thick here and thin there, of all contrasts: the same nearest ones, the same drops."""
    image = cv2.GaussianBlur(rng.random((300, 400)).astype(np.float32) * 255, (0, 0), 3.0)
    pixels = np.concatenate([rng.uniform(20, 280, (800, 2)), rng.uniform(100, 130, (800, 2)), [[399.0, 1.0]]])
    angles = rng.uniform(0.0, np.pi, (len(pixels), 1)) + np.array([0.0, 0.5 * np.pi])
    corners = Corners(pixels, angles, np.exp(rng.uniform(0.0, 5.0, len(pixels))), np.ones(len(pixels)))
    level = Level(np.asarray(image, np.float32), np.ones((0, 0), np.float32), 1.0, 0.0)
    ours, theirs = find_links(corners, level), in_numpy(find_links, corners, level)
    assert (theirs.corner >= 0).sum() > 100
    assert ((ours.corner == theirs.corner) & (ours.arm == theirs.arm)).mean() >= SAME_SHARE
