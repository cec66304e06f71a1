"""A wrongly declared board with markers is named when the calibration fails."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.detect import detect_boards
from rigkit.io.media.images import read_image
from rigkit.synthetic.render import Optics
from rigkit.workflows.inputs.identify_board import why_misplaced, why_not_detected

BOARD = Board("c", 7, 7, 30.0, 30.0, pattern=Charuco("DICT_4X4_100", 22.5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("boards")
    for seed in range(4):
        rng = np.random.default_rng(seed)
        picture = one_board(rng, board=BOARD).render(optics=Optics(0.7, supersample=2), noise_levels=1.0, rng=rng)
        cv2.imwrite(str(root / f"{seed}.png"), np.asarray(picture))
    return root


def calibrate(folder: Path, board: str, tmp_path: Path, *more: str) -> int:
    words = f"charuco:{board}x30,dictionary=DICT_4X4_100,marker_mm=22.5"
    return main(["calibrate", str(folder), "--board", words, "-o", str(tmp_path / "out.json"), *more])


def test_corners_in_wrong_places_of_a_board_have_their_cause(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its first rows have their markers where a board of one column more has them: some corners are found."""
    assert calibrate(folder, "8x8", tmp_path, "--model", "pinhole") != 0
    printed = "".join(capsys.readouterr())
    assert "7 x 7 inner corners are seen, 8 x 8 are declared" in printed


def test_few_corners_that_markers_place_make_no_board(folder: Path) -> None:
    declared = Board("c", 8, 8, 30.0, 30.0, pattern=BOARD.pattern)
    seen = [detect_boards(read_image(path), [declared]) for path in sorted(folder.glob("*.png"))]
    assert [sum(found.board_id == "c" for found in image) for image in seen].count(0) >= 3


def test_mirrored_images_are_named(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mirrored = tmp_path / "mirrored"
    mirrored.mkdir()
    for path in sorted(folder.glob("*.png"))[:2]:
        cv2.imwrite(str(mirrored / path.name), np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))[:, ::-1])
    assert calibrate(mirrored, "7x7", tmp_path, "--model", "pinhole") != 0
    printed = "".join(capsys.readouterr())
    assert "the images are mirrored: '0.png' shows its board only when it is flipped" in printed


def test_a_board_that_is_as_declared_needs_no_words_and_another_kind_some(folder: Path) -> None:
    assert why_not_detected([folder / "0.png"], [BOARD]) is None
    plain, larger = Board("plain", 7, 7, 30.0, 30.0), Board("c", 8, 8, 30.0, 30.0, pattern=BOARD.pattern)
    printed = why_not_detected([folder / "0.png"], [plain, larger])
    assert printed is not None and 'set type = "charuco"' in printed
    printed = why_not_detected([folder / "0.png"], [plain])
    assert printed is not None
    assert 'set type = "charuco", as in --board charuco:7x7xMM,dictionary=DICT_4X4_50,marker_mm=(0.7' in printed
    printed = why_not_detected([folder / "0.png"], [larger])
    assert printed is not None and "8 x 8 are declared" in printed


def test_boards_alike_are_named_where_a_rig_comes_to_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two boards with the same marks are seen at once: either camera takes one of them, not always the same one."""
    large = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in sorted(folder.glob("*.png"))[:2]]
    pictures = [cv2.resize(one, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for one in large]
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        for k, own in enumerate(pictures):
            beside = pictures[k - 1 if name == "left" else k]
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), np.hstack([own, beside]))
    words = "charuco:7x7x30,dictionary=DICT_4X4_100,marker_mm=22.5"
    folders = [str(tmp_path / "left"), str(tmp_path / "right")]
    main(["calibrate", *folders, "--board", words, "-o", str(tmp_path / "rig.json"), "--model", "pinhole"])
    assert "image '0.png': the marks of 'charuco-7x7x30' are seen twice" in "".join(capsys.readouterr())


def test_boards_that_are_as_declared_are_not_misread(folder: Path) -> None:
    """The board is identified once more meanwhile, which takes a minute with large ones: its progress is shown, under
    another name than that of the first time."""
    said: list[str] = []
    assert why_misplaced(sorted(folder.glob("*.png")), [BOARD], lambda what, done, total: said.append(what)) is None
    assert set(said) == {"checking which board it is"}
    assert why_misplaced([folder / "0.png"], [Board("plain", 7, 7, 30.0, 30.0)]) is None


def test_images_that_show_nothing_are_not_misread(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((120, 160), 90, dtype=np.uint8))
    assert why_misplaced([tmp_path / "grey.png"], [BOARD]) is None
    assert why_misplaced([tmp_path / "grey.png"], [Board("plain", 7, 7, 30.0, 30.0)]) is None
