"""The renderer against integrals, point sampling, finer sampling, symmetry, and OpenCV's corner refinement."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.circles import Circles
from rigkit.geometry.rigid3 import Rigid3, cam_from_world_look_at
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.photometry import Photometry, Shadow, develop
from rigkit.synthetic.render import Optics, radiance, render
from rigkit.synthetic.scene import Panel, PlacedBoard, room_walls, trihedral

EDGE_LEVELS = 4e-3
"""Without blur a straight edge is exact but for the rounding of single-precision coordinates: of 255 levels."""
EDGE_PX = 4e-4
"""Shift of a straight, blurred edge: a blur of 0.3 px is sampled in steps of 0.25 px."""
FINER_PX, FINEST_PX = 1e-3, 3e-4
"""Shift of corners against an image with twice the sub-samples along each axis, rms: from 4, and from 8."""
SAMPLING_LEVELS = 0.6
"""Point sampling with 2048 symmetric samples a pixel is right to about 0.15 grey levels of 255 (rms 0.03 to 0.1)."""
SAMPLING_MAX_LEVELS = 4.0
SHIFT_PX = 2.5e-3
"""Shift of the sampled image against the rendered one, rms over corners; the sampling alone is wrong by 1e-3 px."""
CV_BIAS_PX = 0.01
"""Mean over a board's corners of cv2.cornerSubPix against truth; half a pixel of a convention would be 0.5."""
CV_RMS_PX = 0.05
"""cv2.cornerSubPix itself is wrong by 0.025 to 0.04 px on edges this sharp."""

BOARD = PlacedBoard(
    Board("a", 6, 5, 50.0, 50.0), Rigid3(exp_so3(np.array([0.5, 0.3, 0.2])), [-130.3, -110.7, 500.0]), 0.5
)
PINHOLE = Pinhole((72, 60), np.array([70.0, 71.5, 35.3, 30.2]))
FISHEYE = KannalaBrandt((72, 60), np.array([66.0, 67.0, 35.3, 30.2, -0.03, 0.004, 0.0, 0.0]))


def sampled(placed: PlacedBoard, camera: Camera, blur_px: float, background: float) -> np.ndarray:
    """Average 2048 point samples a pixel: the pixel's square and the blur by a symmetric low-discrepancy sequence."""
    from scipy.special import ndtri
    from scipy.stats import qmc

    sequence = qmc.Sobol(4, seed=3).random_base2(10)
    offsets = sequence[:, :2] - 0.5 + blur_px * ndtri(np.clip(sequence[:, 2:], 1e-6, 1 - 1e-6))
    offsets = np.concatenate([offsets, -offsets])
    width, height = camera.size_px
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    rotation, origin = placed.world_from_board.rotation, placed.world_from_board.translation_mm
    low, high = placed.edge_squares()
    out = np.zeros((height, width))
    for offset in offsets:
        rays, _ = camera.unproject(pixels + offset)
        depth = (rotation[:, 2] @ origin) / (rays @ rotation[:, 2])
        x, y = np.moveaxis((rays * depth[..., None] - origin) @ rotation[:, :2], -1, 0) / placed.board.square_x_mm
        sheet = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (depth > 0)
        squares = (x > -1) & (x < placed.board.columns) & (y > -1) & (y < placed.board.rows)
        black = squares & ((np.floor(x) + np.floor(y)) % 2 == 0)
        out += np.where(sheet, np.where(black, placed.black, placed.white), background)
    return out / len(offsets)


def shifts(image: np.ndarray, reference: np.ndarray, pixels: np.ndarray) -> float:
    """Return by how much the surroundings of `pixels` (N, 2) are shifted against the reference, rms per axis, px."""
    down, right = np.gradient(reference)
    found = []
    for u, v in np.rint(pixels).astype(int):
        window = (slice(v - 3, v + 4), slice(u - 3, u + 4))
        slopes = np.stack([right[window].ravel(), down[window].ravel()], axis=1)
        found.append(np.linalg.lstsq(slopes, (image - reference)[window].ravel(), rcond=None)[0])
    return float(np.sqrt(np.mean(np.square(found))))


@pytest.mark.parametrize(("camera", "blur_px"), list(product((PINHOLE, FISHEYE), (0.0, 0.7))))
def test_equals_point_sampling(camera: Camera, blur_px: float) -> None:
    image = radiance([BOARD], camera, Rigid3.identity(), optics=Optics(blur_px), background=0.35)
    reference = sampled(BOARD, camera, blur_px, 0.35)
    difference = 255.0 * (image - reference)
    assert np.sqrt(np.mean(difference**2)) < SAMPLING_LEVELS
    assert np.abs(difference).max() < SAMPLING_MAX_LEVELS
    pixels, valid = BOARD.see(camera, Rigid3.identity())
    assert valid.all()
    assert len(pixels) == 30
    assert shifts(image, reference, pixels) < SHIFT_PX


def edge_response(distance: np.ndarray, angle: float, blur_px: float) -> np.ndarray:
    """Return the share beyond a straight edge whose normal has `angle`: step, pixel's square and Gaussian convolved.

    The square is two boxes to the edge: twice the difference of the step's double integral, a Gaussian's for blur.
    """
    across, along = abs(np.cos(angle)), abs(np.sin(angle))

    def twice(d: np.ndarray) -> np.ndarray:
        if blur_px == 0.0:
            return np.asarray(0.5 * np.maximum(d, 0.0) ** 2)
        density = np.exp(-0.5 * (d / blur_px) ** 2) / np.sqrt(2.0 * np.pi)
        return np.asarray(0.5 * ((d**2 + blur_px**2) * ndtr(d / blur_px) + d * blur_px * density))

    far, near = 0.5 * (across + along), 0.5 * (across - along)
    total = twice(distance + far) - twice(distance + near) - twice(distance - near) + twice(distance - far)
    return np.asarray(total / (across * along))


@pytest.mark.parametrize("degrees", [3.0, 20.0, 40.0, 44.5, 45.0, 135.0])
@pytest.mark.parametrize("blur_px", [0.0, 0.3, 0.7])
def test_straight_edge_is_its_integral(degrees: float, blur_px: float) -> None:
    angle, size, f = np.radians(degrees), 96, 100.0
    camera = Pinhole((size, size), np.array([f, f, 47.37, 48.12]))
    rotation = exp_so3(np.array([0.0, 0.0, angle]))
    # Its edge at x = 0 of its own frame, everything else out of sight.
    half_plane = Panel(Rigid3(rotation, rotation @ [100.0, 0.0, f]), 200.0, 200.0, 0.9)
    image = radiance([], camera, Rigid3.identity(), panels=[half_plane], optics=Optics(blur_px), background=0.1)
    v, u = np.indices(image.shape)
    distance = (u - 47.37) * np.cos(angle) + (v - 48.12) * np.sin(angle)
    expected = 0.1 + 0.8 * edge_response(distance, angle, blur_px)
    if blur_px == 0.0:
        assert 255.0 * np.abs(image - expected).max() < EDGE_LEVELS
    step = 1e-4
    slope = 0.8 * (edge_response(distance + step, angle, blur_px) - edge_response(distance - step, angle, blur_px))
    slope /= 2.0 * step
    assert abs((slope * (image - expected)).sum() / (slope**2).sum()) < EDGE_PX


@pytest.mark.parametrize("degrees", [1.0, 20.0, 44.5, 45.0])
@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_more_sub_samples_change_little(lens: str, degrees: float) -> None:
    """At 45 degrees, too, where the corners of cells, not their sides, meet the edge."""
    centre = [79.6, 80.1]
    camera: Camera = Pinhole((160, 160), np.array([160.0, 160.0, *centre]))
    rotation = exp_so3(np.array([0.0, 0.0, np.radians(degrees)]))
    if lens == "fisheye":
        camera = KannalaBrandt((160, 160), np.array([160.0, 160.0, *centre, -0.03, 0.004, 0.0, 0.0]))
        rotation = exp_so3(np.array([0.4, 0.0, 0.0])) @ rotation
    pose = Rigid3(rotation, np.array([0.7, 0.3, 600.0]) - rotation @ [125.0, 125.0, 0.0])
    placed = PlacedBoard(Board("a", 6, 6, 50.0, 50.0), pose, 0.5)
    pixels, valid = placed.see(camera, Rigid3.identity())
    assert valid.all()
    coarse, finer, finest = (
        radiance([placed], camera, Rigid3.identity(), optics=Optics(0.5, supersample=n)) for n in (4, 8, 16)
    )
    assert shifts(coarse, finer, pixels) < FINER_PX
    assert shifts(finer, finest, pixels) < FINEST_PX


def test_half_turn_of_the_camera_turns_the_image() -> None:
    camera = Pinhole((75, 60), np.array([90.0, 90.0, 37.0, 29.5]))
    upright = radiance([BOARD], camera, Rigid3.identity())
    turned = radiance([BOARD], camera, Rigid3(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)))
    np.testing.assert_allclose(turned[::-1, ::-1], upright, atol=2e-4)


@pytest.mark.parametrize("fisheye", [False, True])
def test_opencv_finds_the_corners_where_they_are(fisheye: bool) -> None:
    boards = trihedral([Board(f"plane{k}", 8, 6, 50.0, 50.0) for k in (1, 2, 3)])
    parameters = [560.0, 560.0, 400.0, 310.0]
    camera: Camera = Pinhole((800, 620), np.array(parameters))
    cam_from_world = cam_from_world_look_at((-700, -600, -900), (-150, -100, -150))
    if fisheye:
        camera = KannalaBrandt((800, 620), np.array([320.0, 320.0, 400.0, 310.0, -0.02, 0.001, 0.0, 0.0]))
        cam_from_world = cam_from_world_look_at((-520, -450, -620), (-200, -150, -200))
    image = render(boards, camera, cam_from_world, panels=room_walls(), optics=Optics(0.8))
    for placed in boards:
        pixels, valid = placed.see(camera, cam_from_world)
        assert valid.all()
        start = pixels.astype(np.float32).reshape(-1, 1, 2)
        found = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), (3, 100, 1e-6)).reshape(-1, 2)
        error = found - pixels
        assert np.abs(error.mean(axis=0)).max() < CV_BIAS_PX
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < CV_RMS_PX


def test_nearer_board_hides_the_farther_one_and_a_back_shows_no_pattern() -> None:
    near = PlacedBoard(Board("near", 3, 3, 20.0, 20.0), Rigid3(np.eye(3), [-20.0, -20.0, 300.0]), 0.5, white=0.5)
    camera = Pinhole((96, 80), np.array([90.0, 90.0, 47.5, 39.5]))
    for order in ([near, BOARD], [BOARD, near]):
        image = radiance(order, camera, Rigid3.identity())
        pixels, _ = near.see(camera, Rigid3.identity())
        middle = np.rint(pixels.mean(axis=0)).astype(int)
        assert image[middle[1] - 12 : middle[1] + 13, middle[0] - 12 : middle[0] + 13].max() < 0.51
    behind = PlacedBoard(near.board, Rigid3(np.diag([1.0, -1.0, -1.0]), [-20.0, 20.0, 300.0]))
    assert not behind.see(camera, Rigid3.identity())[1].any()
    back = radiance([behind], camera, Rigid3.identity())
    assert back[36:44, 44:52].min() > 0.84


def test_nothing_is_seen_at_the_horizon_of_a_print_of_circles() -> None:
    """There a sub-sample spans any length of the board's plane, its circles included."""
    board = Board("c", 9, 7, 30.0, 30.0, pattern=Circles(diameter_mm=15.0))
    camera = KannalaBrandt((160, 120), np.array([59.0, 59.0, 81.0, 57.8, -0.022, 0.0015, 0.0, 0.0]))
    turn = exp_so3(np.array([0.2, 1.0, 0.1]))
    placed = PlacedBoard(board, Rigid3(turn, np.array([0.0, 0.0, 300.0]) - turn @ np.array([120.0, 90.0, 0.0])))
    printed, plain = (radiance([p], camera, Rigid3.identity()) for p in (placed, replace(placed, black=placed.white)))
    pixels, valid = placed.see(camera, Rigid3.identity())
    v, u = np.nonzero(np.abs(printed - plain) > 1e-6)
    nearest = np.hypot(u[:, None] - pixels[valid, 0], v[:, None] - pixels[valid, 1]).min(axis=1)
    assert len(u) > 300 and nearest.max() < 12.0


def test_outside_the_lens_is_black_and_panels_lie_behind_boards() -> None:
    wall = Panel(Rigid3(np.eye(3), [0.0, 0.0, 400.0]), 4e4, 4e4, 0.6)
    image = radiance([BOARD], FISHEYE, Rigid3.identity(), panels=[wall], optics=Optics(0.5, field_deg=50.0))
    radius = np.hypot(*(np.indices(image.shape)[::-1] - np.array([35.3, 30.2])[:, None, None]))
    assert image[radius > 34].max() < 1e-6
    bare = radiance([BOARD], FISHEYE, Rigid3.identity(), optics=Optics(0.5, field_deg=50.0), background=0.6)
    np.testing.assert_allclose(image[radius < 24], bare[radius < 24], atol=1e-6)
    # The second tile begins at column 64: nothing of it is lit.
    narrow = radiance([BOARD], FISHEYE, Rigid3.identity(), panels=[wall], optics=Optics(0.5, field_deg=10.0))
    assert (narrow[:, 64:] == 0.0).all() and narrow[radius < 4].min() > 0.05


def test_motion_and_defocus_keep_the_mean_position() -> None:
    plain = radiance([BOARD], PINHOLE, Rigid3.identity(), optics=Optics(0.5))
    down, right = np.gradient(plain[5:-5, 5:-5])
    for optics in (Optics(0.5, motion_px=(2.6, 1.5)), Optics(0.5, defocus_px=1.6)):
        image = radiance([BOARD], PINHOLE, Rigid3.identity(), optics=optics)
        assert abs(image.sum() / plain.sum() - 1.0) < 1e-2
        assert image.std() < plain.std()
        slopes = np.stack([right.ravel(), down.ravel()], axis=1)
        shift = np.linalg.lstsq(slopes, (image - plain)[5:-5, 5:-5].ravel(), rcond=None)[0]
        assert np.abs(shift).max() < 0.01


def test_photometry(rng: np.random.Generator) -> None:
    flat = np.full((120, 160), 0.5)
    noisy = develop(flat, Photometry(exposure=1.0, noise_levels=5.0), rng)
    assert noisy.dtype == np.uint8
    # Standard error of the sigma of 19200 samples is 0.5 %; rounding to whole levels adds 1/12 to the variance.
    assert abs(noisy.std() / np.sqrt(25.0 + 1.0 / 12.0) - 1.0) < 0.02
    deep = develop(flat, Photometry(exposure=1.0, bits=16))
    assert deep.dtype == np.uint16
    assert abs(int(deep[0, 0]) - 32768) <= 1
    assert develop(flat, Photometry(exposure=4.0)).min() == 255
    dim = develop(
        flat, Photometry(exposure=1.0, vignetting=0.5, gradient=(0.2, 0.0), shadow=Shadow(0.0, 0.3, 0.02, 0.4))
    )
    assert dim[60, 80] > dim[60, 130]
    assert dim[60, 130] < 0.5 * dim[60, 90]
    assert develop(flat, Photometry(exposure=1.0, gamma=0.5))[0, 0] == round(255 * np.sqrt(0.5))
    edge = np.repeat([[0.2] * 80 + [0.8] * 80], 120, axis=0)
    assert develop(edge, Photometry(exposure=1.0, sharpen=0.8)).min() < 51
    assert np.abs(develop(edge, Photometry(exposure=1.0, jpeg_quality=75)).astype(int) - 255 * edge).max() < 40


def test_refusals() -> None:
    with pytest.raises(InputError, match="rng"):
        develop(np.zeros((4, 4)), Photometry(noise_levels=1.0))
    with pytest.raises(InputError, match="8 bits"):
        Photometry(bits=16, jpeg_quality=90)
    with pytest.raises(InputError, match="negative"):
        Optics(blur_px=-1.0)


@pytest.mark.slow
def test_speed() -> None:
    boards = trihedral([Board(f"plane{k}", 8, 6, 50.0, 50.0) for k in (1, 2, 3)])
    cam_from_world = cam_from_world_look_at((-700, -600, -900), (-150, -100, -150))
    for size, focal, limit_s in (((640, 480), 500.0, 0.6), ((1624, 1240), 1350.0, 3.0)):
        camera = Pinhole(size, np.array([focal, focal, size[0] / 2, size[1] / 2]))
        start = time.process_time()
        render(boards, camera, cam_from_world, panels=room_walls())
        assert time.process_time() - start < limit_s
