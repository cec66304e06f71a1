"""The kernels that align and grow patches agree with their definitions in numpy."""

from __future__ import annotations

import cv2
import numpy as np
from helpers.textured_scene import texture
from kernels.reference import patches as reference

from rigkit.affine.refine_patches import patch_pyramid, patch_rules
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.geometry.sampson import epipolar_normals
from rigkit.kernels.patches import EpipolarKnowledge, aligned, grown, starts_of
from rigkit.relative_pose.solvers.pose import essential_from_pose

SINGLE_PX = 2e-4
"""The kernel works in single precision, on brightness to 255, until a patch moves by less than 1e-3 px."""
SIGMA_REL = 0.02
"""Of standard deviations: single precision in sums of a few hundred squares."""
HALF, STEP = 7, 8
A21 = np.array([[1.04, 0.08], [-0.05, 0.97]])
SHIFT = np.array([6.3, -3.4])
SIZE = (150, 130)


def pair_of_images(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A textured plane from two sides, one affinity everywhere, with a grey level of noise."""
    wall = texture(rng)[:400, :400]
    second = cv2.warpAffine(wall, np.column_stack([A21, SHIFT]), SIZE, flags=cv2.INTER_CUBIC)
    first = wall[: SIZE[1], : SIZE[0]]
    first, second = (v + rng.normal(0.0, 1.0, v.shape) for v in (first, second))
    return first.astype(np.float32), second.astype(np.float32)


def smoothed(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float64)


def test_patches_are_aligned_as_defined(rng: np.random.Generator) -> None:
    image1, image2 = pair_of_images(rng)
    q1 = rng.uniform([25.0, 25.0], [120.0, 100.0], (30, 2))
    q2 = q1 @ A21.T + SHIFT + rng.uniform(-0.8, 0.8, (30, 2))
    A = A21 + rng.uniform(-0.05, 0.05, (30, 2, 2))
    rules = patch_rules(HALF, max_move=4.0)
    found = aligned(patch_pyramid(image1), patch_pyramid(image2), rules, starts_of(q1, q2, A))
    good = np.flatnonzero(np.isfinite(found.correlation))
    assert len(good) > 25
    for k in good:
        place, affinity, correlation, spread = reference.aligned(
            smoothed(image1), smoothed(image2), q1[k], q2[k], A[k], half=HALF, width=0.6 * HALF
        )
        np.testing.assert_allclose(found.pixels2[k], place, atol=SINGLE_PX)
        np.testing.assert_allclose(found.A21[k], affinity, atol=SINGLE_PX)
        assert abs(found.correlation[k] - correlation) < SINGLE_PX
        ours, theirs = (np.sqrt(np.diag(c)) for c in (found.covariance[k], spread))
        np.testing.assert_allclose(ours, theirs, rtol=SIGMA_REL)
    off = found.pixels2[good] - (q1[good] @ A21.T + SHIFT)
    assert np.median(np.linalg.norm(off, axis=1)) < 0.05


def test_patches_grow_as_defined(rng: np.random.Generator) -> None:
    image1, image2 = pair_of_images(rng)
    q1 = np.array([[60.3, 50.2]])
    seeds = starts_of(q1, q1 @ A21.T + SHIFT + 0.3, A21[None])
    rules = patch_rules(HALF, max_move=2.0, min_correlation=0.9)
    rows, columns = (SIZE[1] - 1) // STEP + 1, (SIZE[0] - 1) // STEP + 1
    rays1 = np.zeros((rows, columns, 3))
    free = EpipolarKnowledge.make(
        np.zeros((4, 4, 3)), 8.0, np.zeros((3, 3)), sigma=np.inf, sigma_A=np.inf, max_distance=np.inf
    )
    pyramids = patch_pyramid(image1), patch_pyramid(image2)
    found = grown(*pyramids, free, rules, rays1, np.zeros((rows, columns, 3, 2)), STEP, 3, seeds)
    expected = reference.grown(
        smoothed(image1),
        smoothed(image2),
        seeds,
        STEP,
        half=HALF,
        width=0.6 * HALF,
        min_correlation=0.9,
        max_move=2.0,
        max_tries=3,
    )
    have = np.flatnonzero(np.isfinite(found.correlation))
    assert len(expected) > 80
    # Patches that only just fit into the image are decided on another way.
    common = [k for k in have if divmod(int(k), columns) in expected]
    assert len(common) > 0.95 * len(expected)
    assert len(have) < 1.2 * len(expected)
    for k in common:
        place, affinity, _ = expected[divmod(int(k), columns)]
        np.testing.assert_allclose(found.pixels2[k], place, atol=10 * SINGLE_PX)
        np.testing.assert_allclose(found.A21[k], affinity, atol=10 * SINGLE_PX)


def test_what_is_known_of_the_epipolar_line_is_used(rng: np.random.Generator) -> None:
    """Of a fisheye: the pair is drawn to its line by as much as the knowledge weighs against the images."""
    image1, image2 = pair_of_images(rng)
    lens = KannalaBrandt(SIZE, np.array([70.0, 71.0, 75.0, 64.0, -0.02, 0.003, 0.0, 0.0]))
    sigma, sigma_A, spacing, step = 0.05, 0.02, 4.0, 60
    # The seed is at a node, so that it is what grows; half a pixel above it in image 2 runs its line.
    q1 = np.array([[60.0, 60.0]])
    f1, f2 = lens.unproject(q1)[0][0], lens.unproject(q1 @ A21.T + SHIFT - [0.0, 0.5])[0][0]
    axis = np.cross(f1, f2)
    R = exp_so3(axis / np.linalg.norm(axis) * np.arcsin(np.linalg.norm(axis)))
    E21 = essential_from_pose(Rigid3(R, np.array([-1.0, 0.1, 0.05])))
    seeds = starts_of(q1, q1 @ A21.T + SHIFT, A21[None])
    nodes = np.stack(np.meshgrid(np.arange(0.0, SIZE[0], step), np.arange(0.0, SIZE[1], step)), axis=-1)
    coarse = np.stack(np.meshgrid(spacing * np.arange(40), spacing * np.arange(35)), axis=-1)
    rays1, jacobians1 = lens.unproject(nodes)[0], lens.ray_jacobian(nodes)
    knowledge = EpipolarKnowledge.make(
        lens.unproject(coarse)[0], spacing, E21, sigma=sigma, sigma_A=sigma_A, max_distance=50.0
    )
    rules = patch_rules(HALF, max_move=5.0, excess_noise=4.0)
    pyramids = patch_pyramid(image1), patch_pyramid(image2)
    found = grown(*pyramids, knowledge, rules, rays1, jacobians1, step, 1, seeds)
    at = 1 * nodes.shape[1] + 1
    assert np.isfinite(found.correlation[at])

    def prior(q2: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        f1, f2 = lens.unproject(q1)[0], lens.unproject(q2[None])[0]
        c, n1, n2 = epipolar_normals(E21, f1, f2, lens.ray_jacobian(q1), lens.ray_jacobian(q2[None]))
        length = np.linalg.norm(n2[0])
        across = n2[0] @ A / length
        off = across + n1[0] / length
        rows = np.zeros((3, 6))
        rows[0, 4:] = across / sigma
        rows[1, [0, 2]] = rows[2, [1, 3]] = across / sigma_A
        return rows, np.array([c[0] / length / sigma, *(off / sigma_A)])

    place, affinity, _, spread = reference.aligned(
        smoothed(image1),
        smoothed(image2),
        q1[0],
        q1[0] @ A21.T + SHIFT,
        A21,
        half=HALF,
        width=0.6 * HALF,
        prior=prior,
        excess_noise=4.0,
    )
    free = aligned(*pyramids, patch_rules(HALF, max_move=5.0), seeds)
    assert np.linalg.norm(free.pixels2[0] - place) > 0.1
    # Rays are interpolated between nodes 4 px apart: of a lens of 70 px, to 1e-3 px.
    np.testing.assert_allclose(found.pixels2[at], place, atol=5e-3)
    np.testing.assert_allclose(found.A21[at], affinity, atol=5e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance[at])), np.sqrt(np.diag(spread)), rtol=0.05)
