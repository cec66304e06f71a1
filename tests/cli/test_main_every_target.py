"""Every kind of board through every verb, by the command line, on rendered images with known truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.cameras.base import Camera
from rigkit.cameras.pinhole import Pinhole
from rigkit.cli.main import main
from rigkit.coach.coach import Take
from rigkit.coach.guide import GuideOptions
from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.boards.board_file import board_text
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.io.calibrations.rig_file import load_board_rigs, load_saved_rig
from rigkit.io.media.images import read_image, to_grey
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard, place_board, sees_paper
from rigkit.workflows.capture.coach import open_coach
from rigkit.workflows.options.coach import CoachOptions

SIZE = (640, 480)
LEFT = Pinhole(SIZE, np.array([520.0, 520.0, 321.3, 236.1]))
RIGHT = Pinhole(SIZE, np.array([524.0, 524.0, 317.3, 242.1]))
RIGHT_FROM_LEFT = Rigid3(exp_so3(np.array([0.0, -0.08, 0.01])), np.array([-60.0, 0.0, 5.0]))
CAM_FROM_HAND = Rigid3(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([20.0, -30.0, 60.0]))
BASE_FROM_BOARD = Rigid3(exp_so3(np.array([3.0, 0.2, 0.1])), np.array([600.0, 100.0, 0.0]))
OPTICS, PHOTOMETRY = Optics(0.6, supersample=2), Photometry(exposure=0.95, noise_levels=1.5)
VIEWS, FRESH = 6, 2
SEEDS = {"left": 7, "right": 8, "fresh/left": 9, "fresh/right": 10}

MIN_COSINE = 0.4
"""Of boards in a corner of a room, against the line of sight."""
HELD_OUT_PX = 0.02
"""Corners at noise 1.5 scatter by 0.003 to 0.008 px."""
LENGTH_REL = 3e-4
"""Of baselines: corners of 0.006 px at squares of 30 px."""
HAND_MM = 0.3
ANGLE_DEG = 0.1

KINDS = {
    "chessboard": ("9x6x30", ("8x6x50", "7x6x50", "6x9x50")),
    "charuco": (
        "charuco:9x6x30,dictionary=DICT_5X5_250,marker_mm=22",
        tuple(
            f"charuco:{size}x50,dictionary=DICT_5X5_250,marker_mm=38,first_marker={first}"
            for size, first in (("8x6", 0), ("7x6", 60), ("6x9", 120))
        ),
    ),
    "aprilgrid": (
        "aprilgrid:5x4x42,spacing=0.3",
        tuple(
            f"aprilgrid:{size}x80,spacing=0.3,first_tag={first}"
            for size, first in (("4x3", 0), ("4x3", 20), ("3x4", 40))
        ),
    ),
    "circles": ("circles:9x6x30", ("circles:8x6x50", "circles:7x6x50", "circles:6x9x50")),
    "asymmetric": (
        "circles:4x11x60,layout=asymmetric",
        tuple(f"circles:{size}x90,layout=asymmetric" for size in ("4x9", "5x7", "3x9")),
    ),
}


@dataclass(frozen=True)
class Lab:
    """Images of a kind of board on disk, and what is true of them."""

    kind: str
    root: Path
    board: Board
    words: str
    planes: tuple[str, ...]
    placed: tuple[PlacedBoard, ...]

    @property
    def target(self) -> str:
        return str(self.root / "target.toml")

    def path(self, name: str) -> str:
        return str(self.root / name)


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def placed_before_both(board: Board, count: int, rng: np.random.Generator) -> list[PlacedBoard]:
    out: list[PlacedBoard] = []
    extent = float(np.ptp(board.points()[:, :2], axis=0).max()) / board.square_x_mm + 2.0
    while len(out) < count:
        spot = np.array(SIZE) * rng.uniform(0.25, 0.75, 2)
        placed = place_board(board, LEFT, spot, rng.uniform(0.45, 0.85) * SIZE[1] / extent, 40.0, rng)
        if placed is None or not sees_paper(placed, LEFT, (0.0, 0.0), SIZE):
            continue
        if sees_paper(beside(placed), RIGHT, (0.0, 0.0), SIZE):
            out.append(placed)
    return out


def beside(placed: PlacedBoard) -> PlacedBoard:
    return replace(placed, world_from_board=RIGHT_FROM_LEFT @ placed.world_from_board)


def robot_line(name: str, cam_from_board: Rigid3) -> str:
    base_from_hand = BASE_FROM_BOARD @ cam_from_board.inverse() @ CAM_FROM_HAND
    x, y, z, w = quaternion(base_from_hand.rotation)
    return ",".join([name, *(f"{v:.9f}" for v in (*base_from_hand.translation_mm, x, y, z, w))])


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return x, y, z, w: the eigenvector of the largest eigenvalue (Bar-Itzhack 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array([[a - e - i, b + d, c + g, h - f], [b + d, e - a - i, f + h, c - g], [c + g, f + h, i - a - e, d - b]])
    k = np.vstack([k, [h - f, c - g, d - b, a + e + i]])
    return np.asarray(np.linalg.eigh(k)[1][:, -1])


def shot(placed: Sequence[PlacedBoard], camera: Camera, pose: Rigid3, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(render(placed, camera, pose, optics=OPTICS, photometry=PHOTOMETRY, rng=rng))


def corner_of_a_room(walls: Sequence[Board], rng: np.random.Generator) -> StereoScene:
    """Return a pair in which no board is seen so much from the side that its marks cannot be read."""
    for _ in range(200):
        scene = trihedral_pair(walls, LEFT, PoseType.GENERAL, rng, distance=(0.7, 1.1), parallax_deg=(10.0, 30.0))
        poses = [
            pose @ placed.world_from_board
            for placed in scene.boards
            for pose in (scene.cam1_from_world, scene.cam2_from_world)
        ]
        rays = [pose.apply(walls[0].points().mean(axis=0)) for pose in poses]
        cosines = [
            float(pose.rotation[:, 2] @ ray / np.linalg.norm(ray)) for pose, ray in zip(poses, rays, strict=True)
        ]
        if min(cosines) > MIN_COSINE:
            return scene
    raise AssertionError("no pair shows all boards from near enough to their fronts")


def shoot(lab: Lab, folder: str, numbers: range) -> str:
    """Write an image of some of the boards, by the camera that the folder is named after; return the folder."""
    rng = np.random.default_rng(SEEDS[folder])
    camera, pose = (RIGHT, RIGHT_FROM_LEFT) if folder.endswith("right") else (LEFT, Rigid3.identity())
    for n in numbers:
        write(lab.root / folder / f"{n:02d}.png", shot([lab.placed[n]], camera, pose, rng))
    return lab.path(folder)


@pytest.fixture(scope="module", params=sorted(KINDS))
def lab(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Lab:
    """A board before two cameras; what is below renders and calibrates only where a test asks for it."""
    kind = str(request.param)
    root, rng = tmp_path_factory.mktemp(kind), np.random.default_rng(5)
    words, planes = KINDS[kind]
    board = replace(board_of_words(words), board_id="target")
    (root / "target.toml").write_text(board_text(board, "as designed", root / "target.toml"))
    return Lab(kind, root, board, words, planes, tuple(placed_before_both(board, VIEWS + FRESH, rng)))


@pytest.fixture(scope="module")
def left(lab: Lab) -> str:
    return shoot(lab, "left", range(VIEWS))


@pytest.fixture(scope="module")
def right(lab: Lab) -> str:
    return shoot(lab, "right", range(VIEWS))


@pytest.fixture(scope="module")
def fresh(lab: Lab) -> str:
    """Images that no calibration sees."""
    return shoot(lab, "fresh/left", range(VIEWS, VIEWS + FRESH))


@pytest.fixture(scope="module")
def fresh_right(lab: Lab) -> str:
    return shoot(lab, "fresh/right", range(VIEWS, VIEWS + FRESH))


@pytest.fixture(scope="module")
def calibration(lab: Lab, left: str) -> str:
    reported = ["--board", lab.target, "--model", "pinhole", "-o", lab.path("calibration.json")]
    assert main(["calibrate", left, *reported]) == 0
    return lab.path("calibration.json")


@pytest.fixture(scope="module")
def room(lab: Lab) -> tuple[Board, ...]:
    """Three boards in the corner of a room: as a pair for a manifest, and as two images of one mount."""
    walls = [replace(board_of_words(text), board_id=f"plane{n}") for n, text in enumerate(lab.planes, start=1)]
    rng = np.random.default_rng(6)
    for side, image in enumerate(
        corner_of_a_room(walls, rng).images(optics=OPTICS, photometry=PHOTOMETRY, rng=rng), start=1
    ):
        write(lab.root / f"set/pair/view{side}.png", image)
        write(lab.root / f"mount/{side}.png", image)
    return tuple(walls)


def test_every_board_is_printed(lab: Lab) -> None:
    assert main(["board", lab.target, "--paper", "a1", "-o", lab.path("print")]) == 0
    assert all(Path(lab.path(f"print.{end}")).stat().st_size > 0 for end in ("pdf", "svg"))


def test_every_board_is_identified_from_images(lab: Lab, fresh: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["board", "identify", fresh]) == 0
    printed = capsys.readouterr().out
    assert f"seen in {FRESH} of {FRESH} images" in printed
    kind, _, size = lab.words.split(",")[0].rpartition(":")
    assert f"--board {f'{kind}:' if kind else ''}{size.rpartition('x')[0]}xMM" in printed


def test_every_board_calibrates_one_camera(lab: Lab, calibration: str) -> None:
    found = load_calibration(calibration)
    assert found.heldout_rms_px is not None and found.heldout_rms_px < HELD_OUT_PX
    assert not found.dropped and len(found.views) == VIEWS
    (shape,) = found.boards
    assert shape.declared is not None and shape.declared.pattern == lab.board.pattern
    assert shape.board.size == lab.board.size


def test_check_recognises_every_board(calibration: str, fresh: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", calibration, fresh]) == 0
    assert "Still holds" in capsys.readouterr().out


def test_rig_and_its_check_and_certificate(
    lab: Lab, left: str, right: str, fresh: str, fresh_right: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = lab.path("rig.json")
    assert main(["calibrate", left, right, "--board", lab.target, "--model", "pinhole", "-o", rig, "--force"]) == 0
    saved = load_saved_rig(rig)
    (board,) = saved.boards
    # In words: the calibrated board may be stretched, here by rounding.
    assert board.describe() == lab.board.describe()
    poses = [pose for _, pose in saved.cameras.values()]
    found = (poses[1] @ poses[0].inverse()).translation_mm
    true = RIGHT_FROM_LEFT.translation_mm
    assert np.linalg.norm(found - true) < 10.0 * LENGTH_REL * float(np.linalg.norm(true)) + 0.05
    assert main(["check", rig, fresh, fresh_right]) == 0
    assert main(["certify", rig, "--length", "100", "--distance", "400"]) == 0
    assert "95 %" in capsys.readouterr().out


def test_plan_and_difference(lab: Lab, calibration: str) -> None:
    assert main(["plan", calibration, "-n", "1"]) == 0
    assert main(["plan", "--lens", "60", "--size", "640x480", "--board", lab.words, "-n", "2"]) == 0
    assert main(["diff", calibration, calibration]) == 0


def test_pose_and_hand(lab: Lab, left: str, calibration: str, capsys: pytest.CaptureFixture[str]) -> None:
    known = ["--camera", calibration, "--board", lab.target]
    lines = [robot_line(f"{n:02d}.png", one.world_from_board) for n, one in enumerate(lab.placed[:VIEWS])]
    Path(lab.path("poses.csv")).write_text("\n".join(["image,x_mm,y_mm,z_mm,qx,qy,qz,qw", *lines]) + "\n")
    reported = ["handeye", lab.path("poses.csv"), left, *known, "-o", lab.path("hand.json"), "--force"]
    if lab.board.looks_same_turned:
        # Nobody can say which end of such a board is which, and it is said what to take.
        assert main(reported) == 2
        assert "looks the same turned" in capsys.readouterr().err
        return
    assert main(["pose", *known, lab.path("left/00.png")]) == 0
    assert main(reported) == 0
    result = json.loads(Path(lab.path("hand.json")).read_text())
    moved = np.array(result["cam_from_hand"])[:3, 3] - CAM_FROM_HAND.translation_mm
    assert np.linalg.norm(moved) < HAND_MM


@pytest.mark.usefixtures("room")
def test_pairs_from_a_folder_to_the_tables(lab: Lab, calibration: str, capsys: pytest.CaptureFixture[str]) -> None:
    root = Path(lab.path("set"))
    boards = [item for words in lab.planes for item in ("--board", words)]
    made = ["init", str(root), *boards, "--calibration", calibration, "--pose-type", "general", "--force"]
    assert main(made) == 0
    manifest = root / "dataset.toml"
    angles = ", ".join(
        f'{{ a = "plane{a}", b = "plane{b}", value_deg = 90.0, sigma_deg = {ANGLE_DEG}, how = "as rendered" }}'
        for a, b in ((1, 2), (1, 3), (2, 3))
    )
    text = manifest.read_text().replace("[pairs.truth]", f"[pairs.truth]\nangles = [ {angles} ]")
    manifest.write_text(text)
    out = lab.path("tables")
    assert main(["validate", str(root), "-o", out, "--force", "--no-crosscheck", "--no-pictures", "-j", "1"]) == 0
    assert "all checks passed" in capsys.readouterr().out


def test_boards_on_one_mount(lab: Lab, room: tuple[Board, ...]) -> None:
    session = Path(lab.path("mount/session.toml"))
    names = [wall.board_id for wall in room]
    for wall in room:
        path = session.with_name(f"{wall.board_id}.toml")
        path.write_text(board_text(wall, "as designed", path))
    listed = ", ".join(f'"{name}.toml"' for name in names)
    mounted = ", ".join(f'"{name}"' for name in names)
    session.write_text(
        f'schema = "rigkit.session/1"\nboards = [{listed}]\nimages = "*.png"\nmodel = "pinhole"\n'
        f"[[rigid_boards]]\nboards = [{mounted}]\n"
    )
    assert main(["calibrate", str(session), "-o", lab.path("mount/rig.json"), "--force"]) == 0
    (path,) = Path(lab.path("mount")).glob("rig*boards*.json")
    (mount,) = load_board_rigs(path)
    assert mount.image_count == 2
    assert [placed.board.pattern.type for placed in mount.boards] == [wall.pattern.type for wall in room]
    assert abs(mount.angle_deg("plane1", "plane2")[0] - 90.0) < ANGLE_DEG


def test_the_coach_takes_pictures_of_every_board(lab: Lab, left: str, tmp_path: Path) -> None:
    options = CoachOptions(
        folder=tmp_path / "coached",
        boards=(lab.words,),
        guide=GuideOptions(boards=(board_of_words(lab.words),), hfov_deg=63.0),
    )
    coach = open_coach(options)
    for n in range(VIEWS):
        grey = to_grey(read_image(Path(left, f"{n:02d}.png")))
        state = coach.look([np.repeat(grey[..., None], 3, axis=2)], take=Take.YES)
        assert state["taken"] is not None
    assert "px" in coach.finish()
    assert (tmp_path / "coached" / "calibration.json").exists()
