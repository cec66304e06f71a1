"""Board, session, calibration and rig files: read back equal, and faults are named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.core.errors import InputError
from rigkit.io.boards.board_file import load_board
from rigkit.io.calibrations.calibration_file import load_calibration, load_camera, save_calibration, save_camera
from rigkit.io.manifests.session import load_session

BOARD_TEXT = 'schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n'


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    rng = np.random.default_rng(5)
    views, _, _ = random_views(lens("fish"), 8, rng, reach_deg=92.5)
    spoilt = views[0].pixels.copy()
    spoilt[7] += 30.0
    views[0] = type(views[0])(views[0].image, views[0].board, views[0].grid, spoilt, views[0].sigma_px)
    return calibrate(views, SIZE, model="scaramuzza", degree=6, board="warp")


def test_calibration_comes_back_as_it_was(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    save_calibration(path, calibration)
    back = load_calibration(path)
    assert (back.camera.parameters == calibration.camera.parameters).all()
    assert (load_camera(path).parameters == calibration.camera.parameters).all()
    assert back.rms_px == calibration.rms_px and back.heldout_rms_px == calibration.heldout_rms_px
    assert (back.frame_covariance == calibration.frame_covariance).all()
    assert back.outliers == calibration.outliers and len(back.outliers) == 1
    assert back.candidates == calibration.candidates and back.convergence == calibration.convergence
    assert back.verdicts == calibration.verdicts and back.dropped == calibration.dropped
    for a, b in zip(back.views, calibration.views, strict=True):
        assert (a.residuals_px == b.residuals_px).all() and (a.kept == b.kept).all() and (a.grid == b.grid).all()
        assert a.cam_from_board.allclose(b.cam_from_board)
    assert (back.boards[0].points_mm == calibration.boards[0].points_mm).all()


def test_nothing_is_overwritten_without_force(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text("mine")
    with pytest.raises(InputError, match="--force"):
        save_calibration(path, calibration)
    assert path.read_text() == "mine"
    save_calibration(path, calibration, force=True)
    assert load_camera(path).model == "scaramuzza"


def test_a_camera_alone(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    save_camera(path, lens("reg"))
    assert (load_camera(path).parameters == lens("reg").parameters).all()
    with pytest.raises(InputError, match=r"without covariance, as imported"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(extra=1), "unknown key 'extra'"),
        (lambda d: d.update(schema="rigkit.calibration/9"), "schema"),
        (lambda d: d["camera"].update(model="lens"), "unknown; known"),
        (lambda d: d["camera"]["parameters"].update(fx="wide"), "parameters numbers"),
        (lambda d: d["camera"].update(extra=1), "and no others"),
        (lambda d: d.pop("camera"), "'camera' is missing"),
    ],
)
def test_damaged_camera_files_are_named(change: object, message: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    save_camera(path, lens("reg"))
    data = json.loads(path.read_text())
    change(data)  # type: ignore[operator]
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=message):
        load_camera(path)
    with pytest.raises(InputError, match="does not exist"):
        load_camera(tmp_path / "none.json")


def test_board_file(tmp_path: Path) -> None:
    path = tmp_path / "a9x6.toml"
    path.write_text(BOARD_TEXT + "square_sigma_mm = 0.1\n")
    board = load_board(path)
    assert (board.board_id, board.size, board.square_x_mm, board.square_sigma_mm) == ("a9x6", (9, 6), 30.0, 0.1)
    path.write_text(BOARD_TEXT.replace("square_mm = 30.0", "square_x_mm = 30.0\nsquare_y_mm = 30.1"))
    assert load_board(path).square_y_mm == 30.1
    path.write_text(BOARD_TEXT + "square_x_mm = 30.0\n")
    with pytest.raises(InputError, match="keep one of the two"):
        load_board(path)
    path.write_text(BOARD_TEXT + "colums = 9\n")
    with pytest.raises(InputError, match="did you mean 'columns'"):
        load_board(path)
    path.write_text(BOARD_TEXT.replace("square_mm = 30.0\n", ""))
    with pytest.raises(InputError, match="square_mm"):
        load_board(path)


def test_session_file(tmp_path: Path) -> None:
    (tmp_path / "board.toml").write_text(BOARD_TEXT)
    for name in ("b.png", "a.png", "c.jpg"):
        (tmp_path / name).write_bytes(b"")
    path = tmp_path / "session.toml"
    text = 'schema = "rigkit.session/1"\nimages = "*.png"\nboard = "board.toml"\nmodel = "scaramuzza"\n'
    path.write_text(text)
    session = load_session(path)
    assert [p.name for p in session.images] == ["a.png", "b.png"]
    assert (session.degree, session.board_shape, session.boards[0].board_id) == (None, "auto", "board")
    path.write_text(text.replace('"*.png"', '["c.jpg", "*.png"]') + 'degree = 6\nboard_shape = "warp"\n')
    session = load_session(path)
    assert [p.name for p in session.images] == ["c.jpg", "a.png", "b.png"]
    assert (session.degree, session.board_shape) == (6, "warp")
    for wrong, message in (
        (text + "degre = 6\n", "did you mean 'degree'"),
        (text.replace("scaramuzza", "thin"), "unknown; known"),
        (text + 'boards = ["board.toml"]\n', "keep one of the two"),
    ):
        path.write_text(wrong)
        with pytest.raises(InputError, match=message):
            load_session(path)


WEIRD: tuple[Any, ...] = (
    None,
    True,
    -1,
    10**400,
    1e308,
    float("nan"),
    "x",
    "",
    [],
    {},
    [1],
    [[]],
    [None],
    {"a": 1},
    [[1, 2], [3]],
)


def spoiled(data: object, rng: np.random.Generator) -> object:
    """The same with something strange somewhere inside; what the strange thing is in does not matter."""
    out = json.loads(json.dumps(data))
    inner = out
    for _ in range(int(rng.integers(1, 6))):
        if not inner or not isinstance(inner, dict | list):
            break
        places = list(inner) if isinstance(inner, dict) else range(len(inner))
        place = places[int(rng.integers(len(places)))]
        around, inner = inner, inner[place]
    around[place] = WEIRD[int(rng.integers(len(WEIRD)))]
    return out


@pytest.mark.parametrize(
    ("key", "name", "value"),
    [
        ("boards", "board_id", 0),
        ("boards", "bow_mm", "wide"),
        ("boards", "aspect", True),
        ("candidates", "name", 7),
        ("candidates", "chosen", 1),
        ("candidates", "parameter_count", 1.5),
        ("candidates", "heldout_rms_px", "0.1"),
        ("candidates", "heldout_rms_px", True),
        ("convergence", "iterations", True),
        ("convergence", "reason", None),
    ],
)
def test_values_of_another_kind_are_refused(
    key: str, name: str, value: object, calibration: Calibration, tmp_path: Path
) -> None:
    path = tmp_path / "calibration.json"
    save_calibration(path, calibration)
    data = json.loads(path.read_text())
    entry = data[key][0] if isinstance(data[key], list) else data[key]
    entry[name] = value
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"calibration\.json.*damaged"):
        load_calibration(path)


def test_whatever_stands_in_a_file_is_read_or_the_file_is_named(
    calibration: Calibration, tmp_path: Path, rng: np.random.Generator
) -> None:
    path = tmp_path / "calibration.json"
    save_calibration(path, calibration)
    data = json.loads(path.read_text())
    refused = 0
    for _ in range(120):
        path.write_text(json.dumps(spoiled(data, rng)))
        try:
            load_calibration(path)
        except InputError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 60


def test_verdicts_of_former_files(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    save_calibration(path, calibration)
    data = json.loads(path.read_text())
    assert data["verdicts"][0]["severity"] == calibration.verdicts[0].severity
    data["verdicts"] = [str(finding) for finding in calibration.verdicts]
    path.write_text(json.dumps(data))
    back = load_calibration(path)
    assert [str(f) for f in back.verdicts] == data["verdicts"]
    assert [f.severity for f in back.verdicts] == [f.severity for f in calibration.verdicts]


def test_prints_in_a_few_lines(calibration: Calibration) -> None:
    shown = [calibration, calibration.views[0], calibration.boards[0]]
    for words in map(repr, shown):
        assert len(words.splitlines()) <= 5 and len(words) < 500
    assert calibration.camera.model in repr(calibration) and calibration.views[0].image in repr(calibration.views[0])
