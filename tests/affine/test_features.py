"""Two images of a textured plane at different slants: points, affinities and normals against the true homography."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.affine_scenes import angles_deg

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import match_affine_features
from rigkit.affine.homography import affines_from_homography
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.refine_patches import patch_pyramid, refine_patches
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.geometry.triangulation import triangulate_rays

SIZE = (400, 300)
CAMERA = Pinhole(SIZE, np.array([400.0, 400.0, 199.5, 149.5]))
OVERSAMPLING = 3
CAM1_FROM_PLANE = Rigid3(exp_so3(np.array([0.25, 0.45, 0.1])), [0.0, 0.0, 900.0])
TURN = exp_so3(np.array([0.05, -0.5, 0.25]))
CAM2_FROM_CAM1 = Rigid3(TURN, -TURN @ [0.0, 0.0, 900.0] + [20.0, -10.0, 950.0])


def pixel_from_plane(cam_from_plane: Rigid3) -> np.ndarray:
    """Homography from mm on the plane to pixels."""
    return CAMERA.K @ np.column_stack([cam_from_plane.rotation[:, :2], cam_from_plane.translation_mm])


def rendered(cam_from_plane: Rigid3, texture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The plane, 1 mm a texel, centred on its frame, supersampled, with a little noise."""
    s = OVERSAMPLING
    fine = np.array([[s, 0, (s - 1) / 2], [0, s, (s - 1) / 2], [0, 0, 1.0]])
    centre = np.array([[1.0, 0, -texture.shape[1] / 2], [0, 1, -texture.shape[0] / 2], [0, 0, 1]])
    size = (SIZE[0] * s, SIZE[1] * s)
    image = cv2.warpPerspective(texture, fine @ pixel_from_plane(cam_from_plane) @ centre, size, flags=cv2.INTER_CUBIC)
    image = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    return np.clip(image + rng.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def images() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    octaves = [
        weight * cv2.resize(rng.normal(size=(n, n)).astype(np.float32), (1200, 1200), interpolation=cv2.INTER_CUBIC)
        for n, weight in ((20, 1.0), (80, 1.0), (240, 0.8))
    ]
    texture = np.sum(octaves, axis=0)
    texture = np.clip(127.0 + 40.0 * texture / texture.std(), 0, 255).astype(np.float32)
    cam2 = CAM2_FROM_CAM1 @ CAM1_FROM_PLANE
    return rendered(CAM1_FROM_PLANE, texture, rng), rendered(cam2, texture, rng)


@pytest.fixture(scope="module")
def found(images: tuple[np.ndarray, np.ndarray]) -> Correspondences:
    return match_affine_features(*images, features_per_view=250, tilts=(1.0, 1.5))


def truth(pixels1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    H21 = pixel_from_plane(CAM2_FROM_CAM1 @ CAM1_FROM_PLANE) @ np.linalg.inv(pixel_from_plane(CAM1_FROM_PLANE))
    q = np.concatenate([pixels1, np.ones((len(pixels1), 1))], axis=1) @ H21.T
    return q[:, :2] / q[:, 2:], affines_from_homography(H21, pixels1)[0]


def test_points_and_affinities(found: Correspondences) -> None:
    assert len(found) > 50
    pixels2, A21 = truth(found.pixels1)
    assert found.A21 is not None
    off = np.linalg.norm(found.pixels2 - pixels2, axis=1)
    assert (off < 1.0).mean() > 0.95
    assert np.median(off) < 0.15
    error = np.sqrt(np.mean((found.A21 - A21) ** 2, axis=(1, 2)))
    assert np.median(error) < 0.015
    assert np.median(np.linalg.norm(A21 - np.eye(2), axis=(1, 2))) > 0.3  # there was something to find


def test_predicted_errors_are_of_the_right_size(found: Correspondences) -> None:
    _, A21 = truth(found.pixels1)
    assert found.A21 is not None
    assert found.sigma_A is not None
    error = np.sqrt(np.mean((found.A21 - A21) ** 2, axis=(1, 2)))
    assert 0.3 < np.median(error / found.sigma_A) < 2.0


def test_normals_without_any_board(found: Correspondences) -> None:
    matches, _ = found.matches(CAMERA, CAMERA)
    m = matches
    points, seen = triangulate_rays(m.rays1, m.rays2, CAM2_FROM_CAM1)
    J1, J2 = pair_projection_jacobians(points, m.rays1, m.jacobians1, m.rays2, m.jacobians2, CAM2_FROM_CAM1)
    assert m.A21 is not None
    normals, valid = normals_from_affines(J1, J2, m.A21)
    plane = CAM1_FROM_PLANE.rotation[:, 2]
    plane = -plane * np.sign(plane @ CAM1_FROM_PLANE.translation_mm)
    assert (valid & seen).mean() > 0.95
    assert np.median(angles_deg(normals, np.broadcast_to(plane, normals.shape))[valid & seen]) < 2.5


def test_every_place_once(found: Correspondences) -> None:
    for pixels in (found.pixels1, found.pixels2):
        apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=-1) + 100.0 * np.eye(len(pixels))
        assert apart.min() > 1e-6


def test_deterministic(images: tuple[np.ndarray, np.ndarray]) -> None:
    first, second = (match_affine_features(*images, tilts=(1.0,), features_per_view=200) for _ in range(2))
    np.testing.assert_array_equal(first.pixels2, second.pixels2)


def test_refinement_pulls_in_a_poor_start(images: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> None:
    pixels1 = rng.uniform([130.0, 90.0], [270.0, 210.0], (60, 2))
    pixels2, A21 = truth(pixels1)
    start = A21 + 0.08 * rng.normal(size=A21.shape)
    moved = pixels2 + 0.8 * rng.normal(size=pixels2.shape)
    one, two = (patch_pyramid(v) for v in images)
    out = refine_patches(one, two, pixels1, moved, start)
    assert out.valid.mean() > 0.7
    good = out.valid & (out.correlation > 0.9)
    assert np.median(np.linalg.norm(out.pixels2 - pixels2, axis=1)[good]) < 0.15
    assert np.median(np.abs(out.A21 - A21).max(axis=(1, 2))[good]) < 0.03


def test_patches_outside_are_invalid(images: tuple[np.ndarray, np.ndarray]) -> None:
    at = np.array([[2.0, 2.0], [200.0, 150.0]])
    out = refine_patches(*(patch_pyramid(images[0]),) * 2, at, at, np.stack([np.eye(2)] * 2))
    assert out.valid.tolist() == [False, True]
    np.testing.assert_allclose(out.A21[1], np.eye(2), atol=1e-6)
    assert (
        len(
            refine_patches(
                patch_pyramid(images[0]), patch_pyramid(images[1]), at[:0], at[:0], np.zeros((0, 2, 2))
            ).valid
        )
        == 0
    )


def test_refusals(images: tuple[np.ndarray, np.ndarray]) -> None:
    with pytest.raises(InputError, match="expected HxW"):
        match_affine_features(images[0].astype(float), images[1])
    with pytest.raises(InputError, match="at least 64 px"):
        match_affine_features(images[0][:20], images[1])
    with pytest.raises(InputError, match="tilts are 1 and above"):
        match_affine_features(*images, tilts=(0.5,))
    flat = np.full((200, 200), 90, dtype=np.uint8)
    with pytest.raises(DegenerateError, match="one textured scene"):
        match_affine_features(flat, flat)


def test_colour_and_16_bits_give_the_same(images: tuple[np.ndarray, np.ndarray]) -> None:

    def matched(one: np.ndarray, two: np.ndarray) -> Correspondences:
        return match_affine_features(one, two, tilts=(1.0,), features_per_view=150)

    plain = matched(*images)
    colour = matched(*(np.repeat(v[..., None], 3, axis=2) for v in images))
    deep = matched(*(v.astype(np.uint16) << 8 for v in images))
    np.testing.assert_array_equal(plain.pixels2, colour.pixels2)
    np.testing.assert_array_equal(plain.pixels2, deep.pixels2)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_sensors_that_fill_the_lower_bits_of_16_give_the_same(images: tuple[np.ndarray, np.ndarray], bits: int) -> None:
    plain = match_affine_features(*images, tilts=(1.0,))
    deep = [image.astype(np.uint16) << (bits - 8) for image in images]
    # A hot pixel is no reason to take all others for dark.
    deep[0][4, 4] = 65535
    found = match_affine_features(*deep, tilts=(1.0,))
    assert abs(len(found) - len(plain)) < 0.05 * len(plain)
    same = [np.flatnonzero((np.abs(plain.pixels1 - q) < 1e-9).all(axis=1)) for q in found.pixels1]
    both = [(i[0], j) for j, i in enumerate(same) if i.size]
    assert len(both) > 0.95 * len(plain)
    i, j = np.array(both).T
    np.testing.assert_allclose(found.pixels2[j], plain.pixels2[i], atol=0.01)


def test_what_is_repeated_is_left_out_where_asked(rng: np.random.Generator) -> None:
    # One thing twice, of which the second camera sees one: a match of the other has no rival there.
    texture = 127.0 + 35.0 * cv2.resize(rng.normal(size=(150, 150)), (1200, 1200), interpolation=cv2.INTER_CUBIC)
    texture[350:850, 650:850] = texture[350:850, 400:600]
    hidden = texture + 0.0
    hidden[350:850, 400:600] = 127.0
    hidden[350:850, 650:850] += 6.0 * cv2.resize(rng.normal(size=(100, 40)), (200, 500), interpolation=cv2.INTER_CUBIC)
    poses = [Rigid3(exp_so3(np.array([0.1, slant, 0.0])), [0.0, 0.0, 900.0]) for slant in (0.0, 0.15)]
    H21 = pixel_from_plane(poses[1]) @ np.linalg.inv(pixel_from_plane(poses[0]))
    pictures = [
        rendered(pose, np.clip(one, 0, 255).astype(np.float32), rng)
        for pose, one in zip(poses, (texture, hidden), strict=True)
    ]

    def off(unique: bool) -> np.ndarray:
        pairs = match_affine_features(pictures[0], pictures[1], tilts=(1.0,), unique=unique)
        true = cv2.perspectiveTransform(pairs.pixels1[:, None], H21)[:, 0]
        return np.linalg.norm(pairs.pixels2 - true, axis=1) > 5.0

    every, alone = off(False), off(True)
    # 34 of 311 are wrong, and 12 of 262.
    assert every.sum() > 2 * alone.sum() and len(alone) > 0.8 * len(every)
