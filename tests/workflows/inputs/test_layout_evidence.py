"""Names without known words: boards decide whether images are of one camera or of a rig."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.stereo_pictures import FRAMES

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.progress import silent
from rigkit.detection.detect import detect_boards
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.io.manifests.rig_session import frames_of_images, load_rig_session
from rigkit.io.media.images import Image, read_image
from rigkit.workflows.calibration.calibrate import RigSessionCalibration
from rigkit.workflows.calibration.calibrate_any import calibrate_sources
from rigkit.workflows.inputs.corners import named_images
from rigkit.workflows.inputs.folder_session import cameras_in, images_of_layout, session_of_folders
from rigkit.workflows.inputs.layout_evidence import cameras_seen, moments_by_order
from rigkit.workflows.inputs.layouts import CameraLayout
from rigkit.workflows.options.cameras import Cache, CalibrateOptions, FolderOptions

BOARD = board_of_words("9x6x30")


def arranged(pictures: Path, folder: Path, form: str, sides: tuple[str, str]) -> Path:
    """Images of both cameras under new names."""
    for side, name in zip(("left", "right"), sides, strict=True):
        for k, path in enumerate(sorted(pictures.glob(f"{side}*.jpg"))):
            target = folder / form.format(k=k, side=name)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
    return folder


@pytest.mark.parametrize(
    ("form", "sides"),
    [
        ("{side}/img_{k}.jpg", ("linke Kamera", "rechte Kamera")),
        ("frame{k:02d}_{side}.jpg", ("A", "B")),
        ("frame_{k:04d}/{side}.jpg", ("left", "right")),
        ("{k}_{side}.jpg", ("2211", "2257")),
    ],
)
def test_boards_that_move_alike_make_a_rig(pictures: Path, tmp_path: Path, form: str, sides: tuple[str, str]) -> None:
    folder = arranged(pictures, tmp_path / "photos", form, sides)
    cameras, _ = cameras_seen([folder], [BOARD], folder / "session.toml", silent)
    for path, text in session_of_folders([folder], ["9x6x30"], folder / "session.toml", cameras=cameras).items():
        path.write_text(text)
    session = load_rig_session(folder / "session.toml")
    assert list(session.cameras) == list(sides)
    assert [len(own.images) for own in session.cameras.values()] == [FRAMES, FRAMES]
    frames = frames_of_images({name: list(named_images(own)) for name, own in session.cameras.items()})
    one, other = (list(own.values()) for own in frames.values())
    assert one == other and len(set(one)) == FRAMES


def test_the_command_calibrates_a_folder_for_each_moment(
    pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The corners that tell the cameras are kept: no image is searched twice without a lens."""
    searched = []

    def counted(image: Image, boards: Sequence[Board], **known: Any) -> tuple[BoardDetection, ...]:
        searched.append(known["camera"] is None)
        return detect_boards(image, boards, **known)

    monkeypatch.setattr("rigkit.workflows.inputs.corners.detect_boards", counted)
    folder = arranged(pictures, tmp_path / "photos", "frame_{k:04d}/{side}.jpg", ("1", "2"))
    options = FolderOptions(boards=("9x6x30",), model="brown")
    done = calibrate_sources([folder], options, CalibrateOptions(cache=Cache.UPDATE))
    assert isinstance(done, RigSessionCalibration)
    assert sum(searched) == 2 * FRAMES
    assert done.rig.baseline_mm("1", "2")[0] == pytest.approx(90.0, abs=0.5)
    with pytest.raises(InputError, match="not of 3 cameras"):
        calibrate_sources([folder], replace(options, cameras=3), CalibrateOptions(force=True))


@pytest.mark.parametrize("form", ["{side}/{k}.jpg", "{k}/{side}.jpg", "{side}_{k}.jpg"])
def test_boards_of_one_camera_do_not(pictures: Path, tmp_path: Path, form: str) -> None:
    """Images of one camera in two folders, in one for each place, or under two names."""
    folder = tmp_path / "photos"
    for k, path in enumerate(sorted(pictures.glob("left*.jpg"))[:6]):
        target = folder / form.format(k=k // 2, side=("day1", "day2")[k % 2])
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
    if form == "{side}_{k}.jpg":
        assert list(cameras_seen([folder], [BOARD], folder / "session.toml", silent)[0]) == [""]
        return
    with pytest.raises(InputError, match=r"--cameras 1; .* 2 cameras .*\(--cameras 2\), but boards do not move alike"):
        cameras_seen([folder], [BOARD], folder / "session.toml", silent)


def test_images_beside_those_of_another_camera_are_chosen_by_a_part_of_their_names(tmp_path: Path) -> None:
    paths = {side: [tmp_path / f"frame{k:02d}_{side}.jpg" for k in range(3)] for side in "AB"}
    for path in (*paths["A"], *paths["B"]):
        path.touch()
    cameras = {side: {str(k): path for k, path in enumerate(own)} for side, own in paths.items()}
    found = images_of_layout(CameraLayout(cameras, ("0", "1", "2")))
    assert {side: sorted(f for _, form in own for f in tmp_path.glob(form)) for side, own in found.items()} == paths
    assert all(len(own) == 1 for own in found.values())


@pytest.mark.parametrize("form", ["{k}/{side}.jpg", "{side}_{k}.jpg"])
def test_boards_that_do_not_move_alike_make_no_rig(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rigkit.workflows.inputs.layout_evidence.on_one_mount", lambda *_: False)
    for k, side in product(range(3), ("day1", "day2")):
        path = tmp_path / form.format(k=k, side=side)
        path.parent.mkdir(exist_ok=True)
        path.touch()
    if form == "{side}_{k}.jpg":
        with caplog.at_level("INFO"):
            assert list(cameras_seen([tmp_path], [BOARD], tmp_path / "session.toml", silent)[0]) == [""]
        assert "by the boards they are one camera's" in caplog.text
        return
    with pytest.raises(InputError, match=r"--cameras 1; .* 2 cameras .*\(--cameras 2\), but boards do not move alike"):
        cameras_seen([tmp_path], [BOARD], tmp_path / "session.toml", silent)


@pytest.mark.parametrize("turned", [False, True], ids=["twice", "rotated"])
def test_an_image_and_its_copy_are_of_one_camera(pictures: Path, tmp_path: Path, turned: bool) -> None:
    for k, path in enumerate(sorted(pictures.glob("left*.jpg"))):
        shutil.copy(path, tmp_path / f"{k}a.jpg")
        image = read_image(path)
        cv2.imwrite(str(tmp_path / f"{k}b.jpg"), np.ascontiguousarray(image[::-1, ::-1]) if turned else image)
    assert list(cameras_seen([tmp_path], [BOARD], tmp_path / "session.toml", silent)[0]) == [""]


def test_images_of_other_moments_are_told_of_early_and_nothing_is_left(
    pictures: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The right images of a rig in another order."""
    for side, step in (("left", 1), ("right", 3)):
        (tmp_path / side).mkdir()
        images = sorted(pictures.glob(f"{side}*.jpg"))
        assert len(images) % 3
        for k, path in enumerate(images):
            shutil.copy(path, tmp_path / side / f"{k * step % len(images):02d}.jpg")
    folders, before = [tmp_path / "left", tmp_path / "right"], set(tmp_path.rglob("*"))
    declared = FolderOptions(boards=("9x6x30",), model="brown")
    options = CalibrateOptions(output=tmp_path / "new.json", cache=Cache.UPDATE)
    with caplog.at_level("WARNING"), pytest.raises(DegenerateError, match="disagree"):
        calibrate_sources(folders, declared, options)
    assert [r.message.partition(",")[0] for r in caplog.records].count("as it seems so far") == 1
    assert set(tmp_path.rglob("*")) == before


def test_the_order_of_images_pairs_them_where_boards_agree(pictures: Path, tmp_path: Path) -> None:
    """DSC_1001.jpg with photo 37.jpg; in another order, or one image short, the boards do not move alike. Numbers of
    two counters that overlap (DSC_1003 with IMG_1003) pair images of other moments."""
    names = {side: sorted(pictures.glob(f"{side}*.jpg"))[:4] for side in ("left", "right")}
    order = (2, 3, 0, 1)
    for k, (left, right) in enumerate(zip(*names.values(), strict=True)):
        for folder, source, name in (
            ("A", left, f"DSC_10{k:02d}"),
            ("B", right, f"photo {k + 37}"),
            ("other", names["right"][order[k]], f"photo {k + 37}"),
            ("counter", right, f"IMG_10{k + 1:02d}"),
        ):
            (tmp_path / folder).mkdir(exist_ok=True)
            shutil.copy(source, tmp_path / folder / f"{name}.jpg")
    path, corners = tmp_path / "session.toml", dict[Path, FoundCorners]()

    def paired(*folders: str) -> bool:
        cameras = cameras_in([tmp_path / folder for folder in folders])
        return moments_by_order(cameras, [BOARD], path, corners, silent)

    assert paired("A", "B") and not paired("A", "other") and paired("A", "counter")
    # Boards agree with the numbers that both cameras have: these count, though the order would pair one more.
    (tmp_path / "counter").rename(tmp_path / "gaps")
    for k, image in enumerate(sorted((tmp_path / "gaps").iterdir())):
        image.rename(tmp_path / "gaps" / f"frame_10{k:02d}.jpg")
    shutil.copytree(tmp_path / "A", tmp_path / "others")
    (tmp_path / "others" / "DSC_1003.jpg").rename(tmp_path / "others" / "DSC_1009.jpg")
    assert not paired("others", "gaps")
    for file, text in session_of_folders([tmp_path / "A", tmp_path / "B"], ["9x6x30"], path, by_order=True).items():
        file.write_text(text)
    assert load_rig_session(path).frames == "order"
    (tmp_path / "B" / "photo 38.jpg").unlink()
    assert not paired("A", "B")
