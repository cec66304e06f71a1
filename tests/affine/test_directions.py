"""Directions at chessboard corners against the exact derivatives of the projection."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers.board_scenes import Scene, detection, fisheye_camera, regular_camera, trihedral_scene

from rigkit.affine.directions import direction_field
from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.choices import Support
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.lattice import chord_directions

EXACT_REL = 1e-9
"""Noise-free corners of a flat board: the estimate is the derivative itself; measured 1e-14."""
COVARIANCE_REL = 0.05
"""That the tangent plane turns with its own corner is left out."""
STEP_PX = 1e-3
OPENCV_REL = 2e-3
"""Both minimise the pixel error to first order; at 2 px of noise they agreed to 1.6e-3 of the largest in 20 draws."""

BOARD = Board("a", 8, 6, 50.0, 40.0)
SUPPORTS: list[tuple[Support, int | None]] = [
    ("neighbours", 1),
    ("line", 1),
    ("line", 3),
    ("line", None),
    ("patch", 1),
    ("patch", 2),
    ("patch", None),
]
CAMERAS = {"regular": regular_camera(), "fisheye": fisheye_camera()}


def true_directions(scene: Scene, board: Board, image: int) -> np.ndarray:
    pose = scene.cam1_from_board[board.board_id]
    pose = pose if image == 1 else scene.cam2_from_cam1 @ pose
    camera = scene.camera1 if image == 1 else scene.camera2
    _, _, d_pixels_d_point, _ = camera.project_with_jacobians(pose.apply(board.points()))
    horizontal = d_pixels_d_point @ (pose.rotation[:, 0] * board.square_x_mm)
    vertical = d_pixels_d_point @ (pose.rotation[:, 1] * board.square_y_mm)
    return np.stack([horizontal, vertical, horizontal + vertical], axis=1)


def angle_errors(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    cross = found[..., 0] * truth[..., 1] - found[..., 1] * truth[..., 0]
    return np.arctan2(cross, (found * truth).sum(axis=-1))


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize(("support", "window"), SUPPORTS)
def test_exact_with_lengths_borders_and_diagonals(
    camera: Camera, support: Support, window: int | None, rng: np.random.Generator
) -> None:
    scene = trihedral_scene(rng, (BOARD,), camera)
    one, two = detection(BOARD, scene.pixels1["a"]), detection(BOARD, scene.pixels2["a"])
    for seen, image in ((one, 1), (two, 2)):
        found = direction_field(seen, camera, support=support, window=window)
        truth = true_directions(scene, BOARD, image)
        assert found.valid.all()
        assert np.abs(found.vectors - truth).max() < EXACT_REL * np.abs(truth).max()


def test_exact_beyond_a_right_angle_from_the_axis() -> None:
    """A wide fisheye sees the board far behind its own image plane."""
    camera = KannalaBrandt((2000, 2000), np.array([500.0, 500.0, 999.5, 999.5, -0.01, 0.0, 0.0, 0.0]))
    rotation = exp_so3(np.array([0.0, 1.7, 0.0])) @ exp_so3(np.array([0.3, -0.4, 0.5]))
    pose = Rigid3(rotation, exp_so3(np.array([0.0, 1.85, 0.0])) @ np.array([-100.0, -80.0, 500.0]))
    pixels, valid = camera.project(pose.apply(BOARD.points()))
    rays, _ = camera.unproject(pixels)
    assert valid.all() and (rays[:, 2] < 0.0).sum() > 20
    scene = Scene((BOARD,), camera, camera, {"a": pose}, Rigid3.identity(), {"a": pixels}, {"a": pixels})
    truth = true_directions(scene, BOARD, 1)
    for support, window in SUPPORTS:
        found = direction_field(detection(BOARD, pixels), camera, support=support, window=window)
        assert np.abs(found.vectors - truth).max() < EXACT_REL * np.abs(truth).max()


@pytest.mark.parametrize(("support", "window"), [("neighbours", 1), ("line", 1), ("patch", 1), ("patch", 2)])
def test_predicted_covariance_is_that_of_the_derivatives(
    support: Support, window: int | None, rng: np.random.Generator
) -> None:
    """By central differences over all corners, each with another sigma."""
    board, camera = Board("a", 5, 4, 60.0, 70.0), fisheye_camera()
    pose = Rigid3(exp_so3(np.array([0.2, 0.3, 0.1])), np.array([-180.0, -100.0, 500.0]))
    pixels, valid = camera.project(pose.apply(board.points()))
    assert valid.all()
    seen = replace(detection(board, pixels), sigma_px=rng.uniform(0.03, 0.12, len(pixels)))
    found = direction_field(seen, camera, support=support, window=window)
    by_corner = []
    for i, k in np.ndindex(pixels.shape):
        step = np.zeros_like(pixels)
        step[i, k] = STEP_PX
        ends = [
            direction_field(replace(seen, pixels=pixels + way), camera, support=support, window=window).vectors
            for way in (step, -step)
        ]
        by_corner.append((ends[0] - ends[1]) * (seen.sigma_px[i] / (2.0 * STEP_PX)))
    W = np.stack(by_corner)
    joint = np.einsum("jnka,jnlb->nklab", W, W)
    # The sum of two separate directions leaves out what they share.
    for k in range(3 if support == "patch" else 2):
        worst = np.abs(found.covariance[:, k] - joint[:, k, k]).max(axis=(1, 2))
        assert (worst < COVARIANCE_REL * np.trace(joint[:, k, k], axis1=1, axis2=2)).all()
    if support == "patch":
        assert np.abs(found.shared - joint[:, 0, 1]).max() < COVARIANCE_REL * np.abs(joint).max()


def test_whole_board_patch_is_opencv_homography(rng: np.random.Generator) -> None:
    """Through a pinhole the whole-board fit is the homography with the smallest pixel error, far from exact corners."""
    scene = trihedral_scene(rng, (BOARD,), regular_camera())
    seen = detection(BOARD, scene.pixels1["a"], rng, 2.0)
    h, _ = cv2.findHomography(seen.grid.astype(np.float64), seen.pixels, 0)
    scaled = np.column_stack([seen.grid, np.ones(48)]) @ h.T
    fitted = scaled[:, :2] / scaled[:, 2:]
    theirs = (h[None, :2, :2] - fitted[:, :, None] * h[None, 2:, :2]) / scaled[:, 2, None, None]
    ours = direction_field(seen, scene.camera1, support="patch", window=None).vectors
    error = np.abs(ours[:, :2] - np.swapaxes(theirs, 1, 2)).max() / np.abs(ours).max()
    assert error < OPENCV_REL


def test_wider_support_is_quieter(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, (BOARD,), regular_camera())
    truth = true_directions(scene, BOARD, 1)
    draws = [detection(BOARD, scene.pixels1["a"], rng, 0.1) for _ in range(20)]

    def rms(support: Support, window: int | None) -> float:
        fields = [direction_field(d, scene.camera1, support=support, window=window) for d in draws]
        return float(np.sqrt(np.mean([angle_errors(f.vectors, truth) ** 2 for f in fields])))

    paper, patch1, patch2, whole = rms("neighbours", 1), rms("patch", 1), rms("patch", 2), rms("patch", None)
    assert whole < patch2 < patch1 < paper
    assert patch2 < 0.5 * paper


@pytest.mark.parametrize(("support", "window"), SUPPORTS)
def test_missing_corners(support: Support, window: int | None, rng: np.random.Generator) -> None:
    """Holes leave exact directions where enough corners are left, and say where there are not."""
    scene = trihedral_scene(rng, (BOARD,), regular_camera())
    pixels = scene.pixels1["a"].copy()
    pixels[[10, 11, 12, 30, 47]] = np.nan
    seen = detection(BOARD, pixels)
    found = direction_field(seen, scene.camera1, support=support, window=window)
    keep = np.isfinite(pixels).all(axis=1)
    truth = true_directions(scene, BOARD, 1)[keep]
    error = np.abs(found.vectors - truth)[found.valid]
    # A window of three corners that has lost one determines nothing; all other supports reach further.
    assert found.valid.mean() > (0.7 if (support, window) == ("line", 1) else 0.85)
    assert error.max() < 1e-7 * np.abs(truth).max()
    assert np.isnan(found.vectors[~found.valid]).all()


TANGENT_CHORD_REL = 0.05
"""Chords are taken in the tangent plane at each corner; in the image plane of a perspective view they are longer or
shorter by what the plane is turned within a square."""


def test_chords_are_the_papers(rng: np.random.Generator) -> None:
    """Those of the synthetic study in perspective images, border and all; in angle they are exact."""
    camera = Pinhole((1624, 1240), np.array([1350.0, 1350.0, 805.0, 622.0]))
    scene = trihedral_scene(rng, (BOARD,), camera)
    pixels = scene.pixels1["a"]
    found = direction_field(detection(BOARD, pixels), camera, support="chord")
    expected = chord_directions(pixels.reshape(BOARD.rows, BOARD.columns, 2)).reshape(-1, 3, 2)
    assert found.valid.all()
    assert angle_errors(found.vectors, expected).max() < 1e-6
    assert np.linalg.norm(found.vectors, axis=-1) == pytest.approx(
        np.linalg.norm(expected, axis=-1), rel=TANGENT_CHORD_REL
    )
    truth = true_directions(scene, BOARD, 1)
    assert angle_errors(found.vectors, truth).max() < 1e-6
    length = np.linalg.norm(found.vectors, axis=-1) / np.linalg.norm(truth, axis=-1)
    assert np.abs(length - 1.0).max() > 0.01


def test_two_rows_have_no_vertical_length() -> None:
    board = Board("thin", 5, 2, 30.0, 30.0)
    pixels = board.points()[:, :2] + 300.0
    field = direction_field(detection(board, pixels), regular_camera(), support="neighbours")
    assert field.valid[:, 0].all() and not field.valid[:, 1:].any()


def test_bad_options() -> None:
    seen = detection(BOARD, BOARD.points()[:, :2] + 300.0)
    with pytest.raises(InputError, match="window"):
        direction_field(seen, regular_camera(), window=0)
    with pytest.raises(InputError, match="unknown"):
        direction_field(seen, regular_camera(), support="star")  # type: ignore[arg-type]
