"""The demo capture is complete and readable, and its truth belongs to its images."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import read_grey

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.boards.board_file import load_board
from rigkit.io.manifests.manifest import load_dataset
from rigkit.io.manifests.session import load_session
from rigkit.synthetic.demo import OPTICS, build_demo

VIEWS = 3
SIZE_PX = (640, 480)
CAMERA = KannalaBrandt(SIZE_PX, np.array([235.0, 235.0, 322.7, 237.0, -0.021, 0.0012, 0.0, 0.0]))
"""The demo's lens with two thirds of its pixels along each axis: its images are made in half of the time."""
CORNER_PX = 0.08
"""cv2.cornerSubPix on images with noise 1.5 and squares seen at a slant, rms; a wrong pose would be tens of pixels."""


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("demo") / "capture"
    with pytest.MonkeyPatch.context() as patch:
        # Views for a calibration are all alike; `rigkit demo` makes ten.
        patch.setattr("rigkit.synthetic.demo.VIEWS", VIEWS)
        patch.setattr("rigkit.synthetic.demo.OPTICS", replace(OPTICS, supersample=2))
        patch.setattr("rigkit.synthetic.demo.demo_camera", lambda: CAMERA)
        assert build_demo(root, np.random.default_rng(1)) == root / "dataset.toml"
    return root


def refined(image: Path, corners: list[list[float]]) -> float:
    """Return the rms distance of OpenCV's corners from the true ones."""
    grey = read_grey(image)
    assert grey.shape == SIZE_PX[::-1]
    truth = np.array(corners)
    start = truth.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(grey, start, (3, 3), (-1, -1), (3, 50, 1e-4)).reshape(-1, 2)
    return float(np.sqrt(np.median(np.sum((found - truth) ** 2, axis=1))))


def test_truth_belongs_to_the_images(demo: Path) -> None:
    truth = json.loads((demo / "truth.json").read_text())
    assert len(truth["calibration"]) == VIEWS
    for name, view in truth["calibration"].items():
        assert refined(demo / "cameras/fisheye/images" / name, view["corners_px"]) < CORNER_PX
    camera = CAMERA
    for name, pair in truth["pairs"].items():
        move = Rigid3.from_matrix(pair["cam2_from_cam1"])
        assert abs(np.linalg.norm(move.translation_mm) - pair["baseline_mm"]) < 1e-9
        for board in pair["boards"].values():
            points = np.array(board["points_in_cam1_mm"])
            np.testing.assert_allclose(camera.project(points)[0], board["corners1_px"], atol=1e-9)
            np.testing.assert_allclose(camera.project(move.apply(points))[0], board["corners2_px"], atol=1e-9)
            for k in (1, 2):
                assert refined(demo / f"images/{name}/view{k}.png", board[f"corners{k}_px"]) < CORNER_PX


def test_manifest_boards_and_session_are_read(demo: Path) -> None:
    dataset = load_dataset(demo)
    assert [str(p.pose_type) for p in dataset.pairs] == ["general", "standard"]
    assert [b.size for b in dataset.boards] == [(8, 6), (7, 6), (6, 9)]
    for pair in dataset.pairs:
        pair.require_images()
        assert pair.truth.baseline is not None
        assert len(pair.truth.angles) == 3
    session = dataset.camera("fisheye").session
    assert session is not None
    assert load_session(session) is not None
    assert load_board(demo / "boards/target.toml").square_x_mm == 30.0


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(InputError, match="not empty"):
        build_demo(tmp_path, np.random.default_rng(1))
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("there", [True, False])
def test_a_demo_that_cannot_be_written_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: BaseException, there: bool
) -> None:
    root = tmp_path / "demo"
    if there:
        root.mkdir()

    def full(path: Path, image: object) -> None:
        if path.name == "02.png":
            raise fault
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"image")

    monkeypatch.setattr("rigkit.synthetic.demo._write_png", full)
    monkeypatch.setattr("rigkit.synthetic.demo.render", lambda *args, **options: None)
    with pytest.raises(InputError if isinstance(fault, OSError) else KeyboardInterrupt):
        build_demo(root, np.random.default_rng(1))
    assert root.exists() == there
    assert not there or not any(root.iterdir())
