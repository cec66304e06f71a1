"""Batched pairs, directions on lattices and noise of the synthetic study."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.tolerances import EXACT_REL

from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import DirectionPairs
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import unit
from rigkit.synthetic.lattice import chord_directions, harmonic_directions
from rigkit.synthetic.noise import NoisyImages, corner_noise, rotate_directions
from rigkit.synthetic.poses import PairBatch, general_pairs, special_pairs

BOARD = Board("study", 6, 8, 40.0, 40.0)
STANDARD_ERROR = 0.03
"""Relative error of a standard deviation from 2000 samples is 1.6 %; 0.03 is two of those."""


def lattice(points: np.ndarray) -> np.ndarray:
    return (1350.0 * points[..., :2] / points[..., 2:]).reshape(*points.shape[:-2], 3, BOARD.rows, BOARD.columns, 2)


def check_geometry(pairs: PairBatch) -> None:
    points, second = pairs.points_mm, pairs.points_in_2()
    assert (points[..., 2] > 0.0).all()
    residual = np.einsum("tni,tij,tnj->tn", second, pairs.essential(), points)
    assert np.abs(residual).max() < EXACT_REL * 1e6
    for k in range(3):
        board = points[:, pairs.board_index == k]
        normal = pairs.normals[:, k]
        assert np.abs(np.einsum("tni,ti->tn", board - board[:, :1], normal)).max() < EXACT_REL * 1e3
        assert (np.einsum("tni,ti->tn", board, normal) < 0.0).all()
        steps = np.linalg.norm(np.diff(board.reshape(-1, BOARD.rows, BOARD.columns, 3), axis=2), axis=-1)
        np.testing.assert_allclose(steps, 40.0, rtol=EXACT_REL)


def test_general_pairs(rng: np.random.Generator) -> None:
    pairs = general_pairs(BOARD, 40, rng, parallax_deg=(40.0, 60.0))
    assert len(pairs) == 40
    check_geometry(pairs)
    # The corner of the room, seen from both cameras: origin = where the three planes meet.
    offset = np.einsum("tbi,tbi->tb", pairs.normals, pairs.points_mm[:, [0, 48, 96]])
    corner = np.linalg.solve(pairs.normals, offset[..., None])[..., 0]
    eye2 = np.einsum("tji,tj->ti", pairs.rotation21, -pairs.translation21_mm)
    to1, to2 = unit(-corner), unit(eye2 - corner)
    parallax = np.degrees(np.arccos(np.sum(to1 * to2, axis=1)))
    assert parallax.min() > 40.0
    assert parallax.max() < 60.0
    distance = np.linalg.norm(corner, axis=1)
    assert distance.min() > 900.0 * (1 - EXACT_REL)
    assert distance.max() < 1300.0 * (1 + EXACT_REL)
    normals = pairs.normals
    np.testing.assert_allclose(normals @ np.swapaxes(normals, 1, 2), np.tile(np.eye(3), (40, 1, 1)), atol=1e-9)
    rays = unit(pairs.points_mm)
    incidence = -np.einsum("tni,tni->tn", rays, normals[:, pairs.board_index])
    assert incidence.min() > 0.35 - EXACT_REL


@pytest.mark.parametrize("pose_type", [PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD])
def test_special_pairs(pose_type: PoseType, rng: np.random.Generator) -> None:
    pairs = special_pairs(BOARD, 20, pose_type, rng, baseline_mm=250.0)
    check_geometry(pairs)
    np.testing.assert_allclose(np.linalg.norm(pairs.translation21_mm, axis=1), 250.0, rtol=EXACT_REL)
    np.testing.assert_allclose(pairs.rotation21[:, 1], np.tile([0.0, 1.0, 0.0], (20, 1)), atol=1e-12)
    if pose_type is PoseType.STANDARD:
        np.testing.assert_allclose(pairs.translation21_mm[0], [-250.0, 0.0, 0.0], atol=1e-9)
    if pose_type is PoseType.FORWARD:
        np.testing.assert_allclose(pairs.translation21_mm[0], [0.0, 0.0, -250.0], atol=1e-9)


def test_refusals(rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match="general_pairs"):
        special_pairs(BOARD, 5, PoseType.GENERAL, rng)
    with pytest.raises(DegenerateError, match="parallax"):
        general_pairs(BOARD, 5, rng, parallax_deg=(170.0, 175.0))


def test_harmonic_directions_are_the_derivatives(rng: np.random.Generator) -> None:
    pairs = general_pairs(BOARD, 10, rng)
    points = pairs.points_mm
    grid = lattice(points)
    found = harmonic_directions(grid)
    # Exact: d pixel = f (dX - x dZ) / Z with dX the board's edge in space.
    space = points.reshape(10, 3, BOARD.rows, BOARD.columns, 3)
    for axis, k in ((3, 0), (2, 1)):
        edge = np.take(np.diff(space, axis=axis), [0], axis=axis)
        exact = (1350.0 * edge[..., :2] - grid * edge[..., 2:]) / space[..., 2:]
        np.testing.assert_allclose(found[..., k, :], exact, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(found[..., 2, :], found[..., 0, :] + found[..., 1, :])


def test_chords_have_exact_directions_and_point_the_same_way(rng: np.random.Generator) -> None:
    grid = lattice(general_pairs(BOARD, 10, rng).points_mm)
    chords, exact = chord_directions(grid), harmonic_directions(grid)
    cross = chords[..., 0] * exact[..., 1] - chords[..., 1] * exact[..., 0]
    size = np.linalg.norm(chords, axis=-1) * np.linalg.norm(exact, axis=-1)
    assert np.abs(cross / size).max() < 1e-7
    assert ((chords * exact).sum(axis=-1) > 0.0).all()
    assert np.abs(np.linalg.norm(chords, axis=-1) / np.linalg.norm(exact, axis=-1) - 1.0).max() > 0.01


@pytest.mark.parametrize("images", list(NoisyImages))
def test_direction_noise_turns_and_keeps_lengths(images: NoisyImages, rng: np.random.Generator) -> None:
    vectors = rng.normal(0.0, 40.0, (2, 1000, 2, 2))
    clean = DirectionPairs(image1=vectors[0], image2=vectors[1], valid=np.ones((1000, 2), dtype=bool), kinds=("a", "b"))
    noisy = rotate_directions(clean, 0.05, rng, images=images)
    for changed, before, after in zip(
        images.which, (clean.image1, clean.image2), (noisy.image1, noisy.image2), strict=True
    ):
        np.testing.assert_allclose(np.linalg.norm(after, axis=-1), np.linalg.norm(before, axis=-1), rtol=EXACT_REL)
        cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
        angle = np.arctan2(cross, (before * after).sum(axis=-1))
        assert abs(angle.std() - (0.05 if changed else 0.0)) < 0.05 * STANDARD_ERROR * 2
        assert abs(angle.mean()) < 4 * 0.05 / np.sqrt(2000)


def test_corner_noise(rng: np.random.Generator) -> None:
    pixels = rng.uniform(0.0, 1000.0, (1000, 2))
    first, second = corner_noise(pixels, pixels, 0.3, rng, images=NoisyImages.SECOND)
    np.testing.assert_array_equal(first, pixels)
    assert abs((second - pixels).std() / 0.3 - 1.0) < 2 * STANDARD_ERROR
