"""Borders of tags and sizes of markers that are not as declared are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.synthetic.render import Optics
from rigkit.workflows.inputs.image_faults import wrong_print

BORDER = "the tags of board 'b' have a border of {} in the images, {} is declared"
MARKER = "the markers of board 'b' have 0.{} of a square's side in the images, 0.{} is declared"


@pytest.mark.parametrize(
    ("printed", "declared", "told"),
    [
        (AprilGrid(0.3), AprilGrid(0.3, border=1), BORDER.format(2, 1)),
        (
            AprilGrid(0.3, "tag25h9", 1, numbering="opencv"),
            AprilGrid(0.3, "tag25h9", 2, numbering="opencv"),
            BORDER.format(1, 2),
        ),
        (AprilGrid(0.3, inverted=True), AprilGrid(0.3, inverted=True), None),
        (Charuco("DICT_4X4_50", 45.0), Charuco("DICT_4X4_50", 33.0), MARKER.format("75", "55")),
        (Charuco("DICT_5X5_50", 36.0, inverted=True), Charuco("DICT_5X5_50", 36.0, inverted=True), None),
        (Chessboard(), Chessboard(), None),
    ],
    ids=["border 2", "border 1", "white", "markers", "inverted", "chessboard"],
)
def test_prints_unlike_the_declared_ones_are_told(
    tmp_path: Path, printed: Pattern, declared: Pattern, told: str | None, rng: np.random.Generator
) -> None:
    board = Board("b", 8, 6, 60.0, 60.0, pattern=printed)
    scene = one_board(rng, board=board, max_tilt_deg=30.0)
    cv2.imwrite(str(tmp_path / "a.png"), np.asarray(scene.render(optics=Optics(0.7), noise_levels=2.0, rng=rng)))
    (truth,) = scene.truth()
    wrong, sigma_px = replace(board, pattern=declared), np.full(len(truth.grid), 0.1)
    views = [BoardView(name, wrong, truth.grid, truth.pixels, sigma_px) for name in ("a", "gone")]
    images = {"a": tmp_path / "a.png", "gone": tmp_path / "gone.png"}
    found = wrong_print(views, images)
    assert [finding.message for finding in found] == ([] if told is None else [told])
    assert wrong_print(views, {}) == []


def test_a_border_is_told_once(tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]) -> None:
    """Where a calibration is bad, the whole board is compared with the declared one."""
    board = Board("b", 8, 6, 60.0, 60.0, pattern=AprilGrid(0.3))
    for k in range(3):
        scene = one_board(rng, board=board, max_tilt_deg=10.0)
        picture = scene.render(optics=Optics(0.7, supersample=2), noise_levels=2.0, rng=rng)
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.asarray(picture))
    words = "aprilgrid:4x3x60,spacing=0.3,border=1"
    main(["calibrate", str(tmp_path), "--board", words, "--model", "pinhole", "-o", str(tmp_path / "camera.json")])
    printed = "".join(capsys.readouterr())
    assert "border is 1 in the board file, 2 in the images: set border = 2" in printed
    assert "have a border of" not in printed
