"""Render a complete capture: calibration images and stereo pairs of three boards through a fisheye lens.

`build_demo` writes a data set like a real one: manifest, boards, images, measurements. The exact truth is written to
`truth.json`, which the pipeline does not read.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.posetype import PoseType
from rigkit.core.progress import Progress, silent
from rigkit.geometry.rigid3 import Rigid3
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import PlacedBoard, place_board, sees_paper

SIZE_PX = (960, 720)
FIELD_DEG = 180.0
DEMO_PLANES = (Board("plane1", 8, 6, 50.0, 50.0), Board("plane2", 7, 6, 50.0, 50.0), Board("plane3", 6, 9, 50.0, 50.0))
TARGET = Board("target", 9, 6, 30.0, 30.0)
PAIRS = (("general", PoseType.GENERAL, 0.0), ("standard", PoseType.STANDARD, 300.0))
"""Name, pose type, baseline in mm of the stereo pairs."""
RULER_SIGMA_MM = 1.0
SQUARE_SIGMA_DEG = 0.3
VIEW_RADIUS = (0.0, 0.45, 0.62)
"""Distances of calibration boards from the image's centre, over half the image height."""
VIEWS = 10
TARGET_TRIES = 300
SESSION_TOML = """schema = "rigkit.session/1"
images = "images/*.png"
board = "../../boards/target.toml"
model = "scaramuzza"
"""
OPTICS = Optics(0.6, field_deg=FIELD_DEG)
PHOTOMETRY = Photometry(exposure=0.95, vignetting=0.3, gradient=(0.1, -0.06), noise_levels=1.5)


def demo_camera() -> Camera:
    """Return the lens of the demo: 2.7 mm, 180 degrees, over a small sensor."""
    return KannalaBrandt(SIZE_PX, np.array([352.0, 352.0, 484.3, 355.8, -0.021, 0.0012, 0.0, 0.0]))


def build_demo(directory: str | Path, rng: np.random.Generator, progress: Progress = silent) -> Path:
    """Write the demo capture atomically into a new or empty folder, and return the path of its manifest.

    Raises InputError if the folder is not empty, or cannot be written (permission, full disk).
    """
    root = Path(directory)
    if root.is_dir() and any(root.iterdir()):
        raise InputError(f"demo: '{root}' is not empty; give a new folder")
    if root.exists() and not root.is_dir():
        raise InputError(f"demo: '{root}' is a file; give a new folder")
    new = not root.exists()
    try:
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".", dir=root, ignore_cleanup_errors=True) as work:
            _build(Path(work), rng, progress)
            for part in Path(work).iterdir():
                part.replace(root / part.name)
    except BaseException as error:
        if new:
            with suppress(OSError):
                root.rmdir()
        if isinstance(error, OSError):
            raise InputError(f"demo: cannot write '{root}': {error.strerror}; choose another folder") from error
        raise
    return root / "dataset.toml"


def _build(root: Path, rng: np.random.Generator, progress: Progress) -> None:
    camera = demo_camera()
    total = VIEWS + 2 * len(PAIRS)
    targets = [_calibration_view(camera, k, rng) for k in range(VIEWS)]
    for k, target in enumerate(targets):
        image = render([target], camera, Rigid3.identity(), optics=OPTICS, photometry=PHOTOMETRY, rng=rng)
        _write_png(root / f"cameras/fisheye/images/{k + 1:02d}.png", image)
        progress("rendering", k + 1, total)
    scenes = {}
    for n, (name, pose_type, baseline_mm) in enumerate(PAIRS):
        scene = trihedral_pair(
            DEMO_PLANES,
            camera,
            pose_type,
            rng,
            baseline_mm=baseline_mm,
            distance=(0.55, 0.9),
            parallax_deg=(20.0, 45.0),
        )
        for view, image in enumerate(scene.images(optics=OPTICS, photometry=PHOTOMETRY, rng=rng), start=1):
            _write_png(root / f"images/{name}/view{view}.png", image)
            progress("rendering", VIEWS + 2 * n + view, total)
        scenes[name] = scene
    for board in (*DEMO_PLANES, TARGET):
        _write_text(root / f"boards/{board.board_id}.toml", _board_toml(board))
    _write_text(root / "cameras/fisheye/session.toml", SESSION_TOML)
    _write_text(root / "truth.json", json.dumps(_truth(camera, targets, scenes), indent=1))
    _write_text(root / "dataset.toml", _manifest_toml(scenes))


def _calibration_view(camera: Camera, index: int, rng: np.random.Generator) -> PlacedBoard:
    """Return the target for one calibration image, at a distance from the centre that cycles with `index`."""
    width, height = camera.size_px
    centre = np.array([width, height]) / 2.0
    for attempt in range(TARGET_TRIES):
        radius = 0.5 * height * VIEW_RADIUS[index % len(VIEW_RADIUS)]
        angle = 2.4 * index + rng.normal(0.0, 0.3)
        spot = centre + radius * np.array([1.3 * np.cos(angle), np.sin(angle)])
        square_px = 0.055 * height * rng.uniform(0.8, 1.2) * (1.0 - 0.5 * attempt / TARGET_TRIES)
        placed = place_board(TARGET, camera, spot, square_px, 45.0, rng)
        if placed is not None and sees_paper(placed, camera, (0.0, 0.0), camera.size_px):
            return placed
    raise DegenerateError("demo: no calibration view was found in which the whole board is seen")


def _write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _write_png(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    _, data = cv2.imencode(".png", image)
    path.write_bytes(data.tobytes())


def _board_toml(board: Board) -> str:
    return (
        f'schema = "rigkit.board/1"\nid = "{board.board_id}"\n'
        f"columns = {board.columns}   # inner corners\nrows = {board.rows}\nsquare_mm = {board.square_x_mm:g}\n"
    )


def _manifest_toml(scenes: dict[str, StereoScene]) -> str:
    """Return the manifest, with measurements as by a ruler and a set square."""
    out = ['schema = "rigkit.dataset/1"', 'name = "demo"', ""]
    for board in DEMO_PLANES:
        out += ["[[boards]]", f'id = "{board.board_id}"', f'file = "boards/{board.board_id}.toml"', ""]
    out += ["[[cameras]]", 'id = "fisheye"', 'calibration = "cameras/fisheye/calibration.json"', ""]
    names = ", ".join(f'"{b.board_id}"' for b in DEMO_PLANES)
    for name, scene in scenes.items():
        out += ["[[pairs]]", f'id = "{name}"', 'camera1 = "fisheye"', 'camera2 = "fisheye"']
        out += [f'image{k} = "images/{name}/view{k}.png"' for k in (1, 2)]
        out += [f'pose_type = "{scene.pose_type}"', f"boards = [{names}]", "", "[pairs.truth]"]
        how = 'how = "steel rule between tripod marks"'
        out += [f"baseline = {{ value_mm = {scene.baseline_mm:.0f}, sigma_mm = {RULER_SIGMA_MM}, {how} }}"]
        out += ["angles = ["]
        for a, b in ((0, 1), (0, 2), (1, 2)):
            ids = f'a = "{DEMO_PLANES[a].board_id}", b = "{DEMO_PLANES[b].board_id}"'
            out += [f'  {{ {ids}, value_deg = 90.0, sigma_deg = {SQUARE_SIGMA_DEG}, how = "set square" }},']
        out += ["]", ""]
    return "\n".join(out)


def _truth(camera: Camera, targets: list[PlacedBoard], scenes: dict[str, StereoScene]) -> dict[str, Any]:
    """Return the exact truth."""
    return {
        "camera": {"model": camera.model, "size_px": camera.size_px, "parameters": camera.named(camera.parameters)},
        "calibration": {
            f"{k + 1:02d}.png": {
                "cam_from_board": target.world_from_board.matrix().tolist(),
                "corners_px": target.see(camera, Rigid3.identity())[0].tolist(),
            }
            for k, target in enumerate(targets)
        },
        "pairs": {name: _pair_truth(scene) for name, scene in scenes.items()},
    }


def _pair_truth(scene: StereoScene) -> dict[str, Any]:
    first, second = scene.detections()
    return {
        "pose_type": str(scene.pose_type),
        "baseline_mm": scene.baseline_mm,
        "cam2_from_cam1": scene.cam2_from_cam1.matrix().tolist(),
        "boards": {
            placed.board.board_id: {
                "normal_in_cam1": normal.tolist(),
                "points_in_cam1_mm": points.tolist(),
                "corners1_px": d1.pixels.tolist(),
                "corners2_px": d2.pixels.tolist(),
            }
            for placed, normal, points, d1, d2 in zip(
                scene.boards, scene.normals_in_cam1(), scene.points_in_cam1(), first, second, strict=True
            )
        },
    }
