"""Alignment of patches between images of different scales: its sigmas against the exact affinity."""

from __future__ import annotations

import cv2
import numpy as np
from helpers.textured_scene import texture
from numpy.typing import NDArray

from rigkit.affine.refine_patches import levels_of_larger, patch_pyramid, refine_patches

SIDE = 420
OVERSAMPLING = 4
TEXELS_A_PIXEL = 2.0
MAX_GROWTH = 2.1
"""Of errors in sigmas, from images of one scale to where image 2 is less sharp; 2.4 if sigmas do not know of it."""


def view(pattern: NDArray[np.float32], A: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return an image of the pattern, seen by pixels x = A d about the middle, a grey level of noise."""
    at = (np.arange(SIDE * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5 - SIDE / 2
    places = np.stack(np.meshgrid(at, at), axis=-1) @ np.linalg.inv(A).T * TEXELS_A_PIXEL + 1024.0
    x, y = (np.ascontiguousarray(places[..., k], np.float32) for k in (0, 1))
    fine = cv2.remap(pattern, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    image = cv2.resize(fine, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return np.clip(image + rng.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)


def errors_in_sigmas(scale: float, rng: np.random.Generator) -> float:
    """Return the median error of the affinities of patches all over the image, in their sigmas."""
    part = texture(np.random.default_rng(3))[:1024, :1024]
    pattern = np.asarray(cv2.resize(part, (2048, 2048), interpolation=cv2.INTER_CUBIC), np.float32)
    A = scale * np.array([[1.04, -0.14], [0.22, 0.93]])
    first, second = (patch_pyramid(view(pattern, B, rng)) for B in (np.eye(2), A))
    nodes = np.stack(np.meshgrid(*(np.arange(60.0, SIDE - 60.0, 12.0),) * 2), axis=-1).reshape(-1, 2)
    expected = (nodes - SIDE / 2) @ A.T + SIDE / 2
    found = refine_patches(first, second, nodes, expected, np.tile(A, (len(nodes), 1, 1)))
    error = np.sqrt(np.mean((found.A21 - A) ** 2, axis=(1, 2)))[found.valid]
    assert found.valid.sum() > 400
    assert np.median(error) < 0.01
    return float(np.median(error / found.sigma_A[found.valid]))


def test_sigmas_know_where_image_2_is_less_sharp(rng: np.random.Generator) -> None:
    assert errors_in_sigmas(0.77, rng) < MAX_GROWTH * errors_in_sigmas(1.0, rng)


def test_image_1_is_read_more_coarsely_where_it_shows_patches_larger() -> None:
    A = np.array([1.3, 1.0, 0.72, 0.69, 0.36, 0.34])[:, None, None] * np.eye(2)
    np.testing.assert_array_equal(levels_of_larger(A), [0, 0, 0, 1, 1, 2])
