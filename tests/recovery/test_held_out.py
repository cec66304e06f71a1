"""Captures unlike the laboratory's: other boards, lenses, walls and motions, worse images; against exact truth."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.cameras.base import Camera, image_center
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.cli.main import main
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError
from rigkit.core.posetype import PoseType
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, rotation_angle
from rigkit.io.calibrations.calibration_file import save_camera
from rigkit.reconstruction.pairing import match_pair
from rigkit.reconstruction.reconstruct import Reconstruction, reconstruct_pair
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.synthetic.photometry import Photometry, Shadow
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard, exact_detection

SIZE = (960, 720)
MIXED = (Board("plane1", 8, 6, 50.0, 50.0), Board("plane2", 7, 6, 50.0, 50.0), Board("plane3", 6, 9, 50.0, 50.0))
NOISE_PX = 0.05
RULER_MM, SQUARE_DEG = 0.5, 0.1
"""What a careful person's rule and protractor would do; the images are good to a few hundredths of that."""
MAX_CORNERS = 0.95
"""A few at the rim of a fisheye or in a shadow's edge may be refused."""
CORNER_PX = 1.0
"""Every corner is the right one; how good it is, is measured elsewhere."""
SIGMAS = 4.0
"""One correct figure in 16000 lies further from the truth, if its sigma is honest."""
RMS_FACTOR = 1.5
"""Rms of a hundred Sampson distances over the noise: 1 but for 6 % of chance; a wrong pose gives 20 and more."""


def regular_lens(
    hfov_deg: float, *, size_px: tuple[int, int] = SIZE, off_px: tuple[float, float] = (0.0, 0.0)
) -> Camera:
    """Return a lens with barrel distortion and its axis off the middle of the image."""
    focal = 0.5 * size_px[0] / np.tan(np.radians(0.5 * hfov_deg))
    centre = image_center(size_px) + off_px
    return Brown(size_px, np.array([focal, focal, *centre, -0.15, 0.08, 2e-4, -1e-4, 0.0]))


def noisy(detections: tuple[BoardDetection, ...], rng: np.random.Generator) -> tuple[BoardDetection, ...]:
    """Return the detections with Gaussian noise that they know of."""

    def moved(pixels: FloatArray) -> FloatArray:
        return np.asarray(pixels + NOISE_PX * rng.standard_normal(pixels.shape))

    return tuple(replace(d, pixels=moved(d.pixels), sigma_px=np.full(len(d.pixels), NOISE_PX)) for d in detections)


def reconstructed(scene: StereoScene, boards: tuple[Board, ...], rng: np.random.Generator) -> Reconstruction:
    first, second = (noisy(d, rng) for d in scene.detections())
    pair = match_pair("held out", scene.camera1, scene.camera2, first, second, boards)
    return reconstruct_pair(pair, pose_type=scene.pose_type)


def assert_pose_is_true(found: Reconstruction, scene: StereoScene) -> None:
    """The pose fits the corners, and its distance from the truth is what its covariance predicts."""
    assert found.sampson_rms_px < RMS_FACTOR * NOISE_PX
    assert abs(found.baseline_mm - scene.baseline_mm) < SIGMAS * found.baseline_sigma_mm
    turn = rotation_angle(found.cam2_from_cam1.rotation @ scene.cam2_from_cam1.rotation.T)
    assert found.pose_covariance is not None
    assert turn < SIGMAS * np.sqrt(np.trace(found.pose_covariance[:3, :3]))


@pytest.mark.parametrize("seed", [7, 10])
def test_a_level_that_held_badly_does_not_mislead_a_long_lens(seed: int) -> None:
    """Half a degree of tilt is 10 px of a long lens: no exactly planar motion comes near the true one."""
    rng = np.random.default_rng(seed)
    camera = regular_lens(45.0, off_px=(30.0, -20.0))
    scene = trihedral_pair(MIXED, camera, PoseType.PLANAR, rng, level_sigma_deg=0.5, angles_deg=(91.6, 88.0, 90.0))
    assert_pose_is_true(reconstructed(scene, MIXED, rng), scene)


def test_a_wrongly_declared_pose_type_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether a pose comes out or not: which, is chance."""
    rng = np.random.default_rng(5)
    boards = tuple(Board(f"plane{k}", *size, 25.0, 25.0) for k, size in enumerate(((11, 8), (9, 6), (10, 7)), start=1))
    scene = trihedral_pair(boards, regular_lens(30.0), PoseType.GENERAL, rng, parallax_deg=(10.0, 20.0))
    first, second = (noisy(d, rng) for d in scene.detections())
    pair = match_pair("held out", scene.camera1, scene.camera2, first, second, boards)
    words = r"declared 'standard'.* support 'general'"

    def no_scale(*_: object) -> None:
        raise DegenerateError("no scale")

    (note,) = reconstruct_pair(pair, pose_type="forward").notes[:1]
    assert re.search(words.replace("standard", "forward"), note)
    monkeypatch.setattr("rigkit.reconstruction.geometry.metric_pose", no_scale)
    with pytest.raises(DegenerateError, match=f"no scale.*{words}"):
        reconstruct_pair(pair, pose_type="standard", level_sigma_rad=np.radians(0.2))


@pytest.mark.parametrize(
    ("size", "tilt_deg", "distance_mm", "exposure", "noise_levels", "seed"),
    [((6, 4), 76.0, 850.0, 0.9, 5.0, 0), ((5, 5), 76.0, 850.0, 0.9, 8.0, 1), ((5, 5), 75.0, 520.0, 0.45, 7.0, 1)],
)
def test_a_board_seen_at_a_flat_angle_in_a_noisy_image(
    size: tuple[int, int], tilt_deg: float, distance_mm: float, exposure: float, noise_levels: float, seed: int
) -> None:
    """Noise makes more loose corners than the board has: they lie between neighbours four times as far as others."""
    rng = np.random.default_rng(seed)
    camera = Pinhole(SIZE, np.array([1000.0, 1000.0, 480.0, 360.0]))
    board = Board("floor", *size, 40.0, 40.0)
    turn = exp_so3(np.array([np.radians(tilt_deg), 0.0, 0.0])) @ exp_so3(np.array([0.0, 0.0, rng.uniform(-0.3, 0.3)]))
    placed = PlacedBoard(board, Rigid3(turn, np.array([0.0, 0.0, distance_mm]) - turn @ board.points().mean(axis=0)))
    photometry = Photometry(noise_levels=noise_levels, exposure=exposure)
    image = render([placed], camera, Rigid3.identity(), optics=Optics(0.7), photometry=photometry, rng=rng)
    (found,) = detect_boards(image, [board])
    assert found.complete
    # Either way round, where the board looks the same turned.
    truth = exact_detection(placed, camera, Rigid3.identity()).pixels
    assert np.linalg.norm(found.pixels[:, None] - truth, axis=2).min(axis=1).max() < CORNER_PX


def fisheye_lens(field_deg: float, size_px: tuple[int, int] = SIZE) -> Camera:
    """Return a lens whose field of view fills nine tenths of the image's width."""
    half = np.radians(0.5 * field_deg)
    focal = 0.45 * size_px[0] / (half - 0.021 * half**3 + 0.0012 * half**5)
    centre = image_center(size_px) + np.array([-6.0, 4.0])
    return KannalaBrandt(size_px, np.array([focal, focal, *centre, -0.021, 0.0012, 0.0, 0.0]))


def test_two_different_cameras_in_one_pair(tmp_path: Path) -> None:
    """A regular and a 190 degree lens, images of two sizes, a wall that is not perpendicular; as people run it."""
    rng = np.random.default_rng(11)
    cameras = {"one": regular_lens(55.0, size_px=(640, 480)), "two": fisheye_lens(190.0, (800, 600))}
    scene = trihedral_pair(
        MIXED, cameras["one"], PoseType.GENERAL, rng, camera2=cameras["two"], angles_deg=(91.6, 90.0, 90.0)
    )
    images = scene.images(optics=Optics(0.6), photometry=Photometry(exposure=0.9, noise_levels=3.0), rng=rng)
    for name, image in zip(cameras, images, strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
        save_camera(tmp_path / f"{name}.json", cameras[name])
    lines = ['schema = "rigkit.dataset/1"', 'name = "two"']
    for board in MIXED:
        lines += ["[[boards]]", f'id = "{board.board_id}"', f"columns = {board.columns}", f"rows = {board.rows}"]
        lines += [f"square_mm = {board.square_x_mm}"]
    for name in cameras:
        lines += ["[[cameras]]", f'id = "{name}"', f'calibration = "{name}.json"']
    lines += ["[[pairs]]", 'id = "pair"', 'camera1 = "one"', 'camera2 = "two"', 'image1 = "one.png"']
    lines += ['image2 = "two.png"', 'pose_type = "general"', 'boards = ["plane1", "plane2", "plane3"]', "[pairs.truth]"]
    lines += [f'baseline = {{ value_mm = {scene.baseline_mm}, sigma_mm = {RULER_MM}, how = "exact" }}', "angles = ["]
    for a, b, angle_deg in (("plane1", "plane2", 88.4), ("plane1", "plane3", 90.0), ("plane2", "plane3", 90.0)):
        lines += [f'{{ a = "{a}", b = "{b}", value_deg = {angle_deg}, sigma_deg = {SQUARE_DEG}, how = "exact" }},']
    (tmp_path / "dataset.toml").write_text("\n".join([*lines, "]", ""]))
    out = tmp_path / "out"
    assert main(["validate", str(tmp_path), "-o", str(out), "-j", "1", "--no-pictures", "--no-crosscheck"]) == 0


BOARDS = {
    "mixed": MIXED,
    "equal": tuple(Board(f"plane{k}", 9, 6, 40.0, 40.0) for k in (1, 2, 3)),
    "two equal": tuple(Board(f"plane{k}", *size, 30.0, 30.0) for k, size in ((1, (6, 5)), (2, (6, 5)), (3, (7, 7)))),
}
LENSES = {"long": regular_lens(35.0), "wide": regular_lens(85.0), "fisheye": fisheye_lens(190.0)}
BAD_IMAGES = {
    "noise": (Optics(0.6), Photometry(exposure=0.8, vignetting=0.4, noise_levels=8.0)),
    "blur": (Optics(1.7), Photometry(exposure=0.8, vignetting=0.4, noise_levels=4.0)),
    "faint": (Optics(0.8), Photometry(exposure=0.3, gamma=0.5, noise_levels=4.0, shadow=Shadow())),
    "compressed": (Optics(0.8), Photometry(exposure=0.8, noise_levels=4.0, jpeg_quality=60)),
}


@pytest.mark.slow
@pytest.mark.parametrize("pose_type", [PoseType.GENERAL, PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD])
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("boards", BOARDS)
def test_images_of_every_kind(boards: str, lens: str, pose_type: PoseType) -> None:
    """All boards are found and matched corner by corner in bad images, and the pose is as true as it says."""
    kinds = list(BAD_IMAGES)
    number = 12 * list(BOARDS).index(boards) + 4 * list(LENSES).index(lens) + list(PoseType).index(pose_type)
    rng = np.random.default_rng(number)
    optics, photometry = BAD_IMAGES[kinds[number % len(kinds)]]
    distance = (0.6, 0.95) if lens == "fisheye" else (0.9, 1.3)
    scene = trihedral_pair(
        BOARDS[boards], LENSES[lens], pose_type, rng, baseline_mm=150.0, level_sigma_deg=0.3, distance=distance
    )
    one, two = (
        detect_boards(image, BOARDS[boards]) for image in scene.images(optics=optics, photometry=photometry, rng=rng)
    )
    pair = match_pair("held out", scene.camera1, scene.camera2, one, two, BOARDS[boards])
    result = reconstruct_pair(pair, pose_type=pose_type, level_sigma_rad=np.radians(0.3))
    corners = sum(board.corner_count for board in BOARDS[boards])
    assert len(result.boards) == 3
    assert len(pair.captured) > MAX_CORNERS * corners
    points = [np.concatenate(scene.points_in_cam1())]
    points.append(scene.cam2_from_cam1.apply(points[0]))
    pixels = [c.project(p)[0] for c, p in zip((scene.camera1, scene.camera2), points, strict=True)]
    nearest = np.linalg.norm(pair.captured.pixels1[:, None] - pixels[0], axis=2).argmin(axis=1)
    assert np.linalg.norm(pair.captured.pixels2 - pixels[1][nearest], axis=1).max() < CORNER_PX
    assert abs(result.baseline_mm - scene.baseline_mm) < SIGMAS * result.baseline_sigma_mm
