"""`rigkit calibrate` from images to the file, and its messages for bad input."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from helpers.calibration_scenes import random_views
from helpers.data import REPOSITORY

from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.io.corners.corner_cache import CornerCache, FoundCorners
from rigkit.io.disk import writing
from rigkit.io.manifests.session import load_session
from rigkit.planning.plan import plan_views
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import place_board, sees_paper
from rigkit.workflows.calibration import next_pictures
from rigkit.workflows.inputs.corners import first_calibration

IMAGES = REPOSITORY / "datasets" / "lab-a" / "calibration" / "fisheye"
SESSION = 'schema = "rigkit.session/1"\nimages = "*.jpg"\nboard = "board.toml"\nmodel = "kannala_brandt"\n'
BOARD = 'schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n'
GOOD_RMS_PX = 0.1
"""Ray-traced images, corners to about 0.02 px per axis; a wrong corner order gives tens of pixels."""


def write_half(image: Path, half: Path) -> None:
    """Write an image in half of its size."""
    read = np.asarray(cv2.imread(str(image), cv2.IMREAD_GRAYSCALE))
    small = cv2.resize(read, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(half), small, [cv2.IMWRITE_JPEG_QUALITY, 97])


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("halves")
    for k, path in enumerate(sorted(IMAGES.glob("*.jpg"))[:5]):
        write_half(path, folder / f"{k:02d}.jpg")
    return folder


@pytest.fixture
def session(halves: Path, tmp_path: Path) -> Path:
    shutil.copytree(halves, tmp_path, dirs_exist_ok=True)
    (tmp_path / "board.toml").write_text(BOARD)
    path = tmp_path / "session.toml"
    path.write_text(SESSION)
    return path


def test_from_images_to_file_and_again_without_images(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with patch.object(next_pictures, "plan_views", wraps=plan_views) as planned:
        assert main(["calibrate", str(session), "--json", "--report"]) == 0
    assert planned.call_count == 1  # For the page and the JSON.
    reported = json.loads(capsys.readouterr().out)
    assert (session.parent / "calibration.html").read_text().count("data:image/jpeg") == 5
    result = load_calibration(session.parent / "calibration.json")
    assert reported["model"] == "kannala_brandt" and reported["rms_px"] == result.rms_px < GOOD_RMS_PX
    assert len(result.views) == 5 and result.dropped == ()
    assert result.heldout_rms_px is not None

    before = (session.parent / "calibration.json").read_bytes()
    assert main(["calibrate", str(session)]) == 2
    assert "--force" in capsys.readouterr().err
    assert (session.parent / "calibration.json").read_bytes() == before

    # The corners are kept: the same result without the images.
    for path in session.parent.glob("*.jpg"):
        path.unlink()
    assert main(["calibrate", str(session), "--force", "-r", str(session.parent / "page.html")]) == 0
    assert "gone; the corners kept" in (session.parent / "page.html").read_text()
    printed = capsys.readouterr()
    assert "held-out RMS" in printed.out
    assert "no image matches 'images'; the corners of 5 images kept in corners.json are used" in printed.err
    again = load_calibration(session.parent / "calibration.json")
    assert np.array_equal(again.camera.parameters, result.camera.parameters)


def test_a_changed_image_is_detected_again(session: Path) -> None:
    assert main(["calibrate", str(session)]) == 0
    before = load_calibration(session.parent / "calibration.json")
    shutil.copy(session.parent / "00.jpg", session.parent / "01.jpg")
    assert main(["calibrate", str(session), "--force"]) == 0
    after = load_calibration(session.parent / "calibration.json")
    assert not np.array_equal(before.views[1].pixels, after.views[1].pixels)
    assert np.array_equal(after.views[0].pixels, after.views[1].pixels)


def test_removed_images_do_not_come_back_with_the_kept_corners(session: Path) -> None:
    assert main(["calibrate", str(session)]) == 0
    (session.parent / "03.jpg").unlink()
    assert main(["calibrate", str(session), "--force"]) == 0
    for path in session.parent.glob("*.jpg"):
        path.unlink()
    assert main(["calibrate", str(session), "--force"]) == 0
    views = load_calibration(session.parent / "calibration.json").views
    assert [v.image for v in views] == ["00.jpg", "01.jpg", "02.jpg", "04.jpg"]


def test_corners_of_an_earlier_detector_serve_where_the_images_are_gone(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", str(session)]) == 0
    kept = session.parent / "corners.json"
    data = json.loads(kept.read_text())
    # As an earlier detector left them: one image fewer, and every corner elsewhere.
    data["detector"] = "0123456789abcdef" + data["detector"][16:]
    del data["images"]["04.jpg"]
    for entry in data["images"].values():
        for found in (entry, entry["lens"]):
            found["boards"][0]["pixels"] = [[u + 5.0, v] for u, v in found["boards"][0]["pixels"]]
    kept.write_text(json.dumps(data))
    images = {path: path.read_bytes() for path in session.parent.glob("*.jpg")}
    for path in images:
        path.unlink()
    capsys.readouterr()
    centre = load_calibration(session.parent / "calibration.json").camera.parameters[2]
    assert main(["calibrate", str(session), "--force"]) == 0
    assert "corners of 4 images kept in corners.json are used, found by another version" in capsys.readouterr().err
    found = load_calibration(session.parent / "calibration.json")
    assert len(found.views) == 4 and found.camera.parameters[2] - centre == pytest.approx(5.0, abs=0.5)
    # With the images they are found anew, all of them.
    for path, content in images.items():
        path.write_bytes(content)
    assert main(["calibrate", str(session), "--force"]) == 0
    found = load_calibration(session.parent / "calibration.json")
    assert len(found.views) == 5 and found.camera.parameters[2] == pytest.approx(centre, abs=1e-9)


def test_linked_images_go_by_their_own_names(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As stores of data lay them out: links to files that are named by their checksums."""
    store = session.parent / "store"
    store.mkdir()
    for k, path in enumerate(sorted(session.parent.glob("*.jpg"))):
        target = path.rename(store / f"SHA256E-{997 * k}.jpg")
        path.symlink_to(target)
    (session.parent / "twice.jpg").symlink_to(store / "SHA256E-0.jpg")
    assert main(["calibrate", str(session)]) == 0
    views = load_calibration(session.parent / "calibration.json").views
    assert [v.image for v in views] == [f"{k:02d}.jpg" for k in range(5)]
    printed = capsys.readouterr().err
    assert "00.jpg' and" in printed and "twice.jpg' are one file, which counts once" in printed


def test_bad_input(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    board = session.parent / "board.toml"
    board.write_text(BOARD.replace("columns = 9", "columns = 7"))
    assert main(["calibrate", str(session)]) == 2
    assert "9 x 6 inner corners are seen in 5 of 5 images, 7 x 6 are declared" in capsys.readouterr().err

    board.write_text(BOARD.replace("rows = 6", "rows = 7"))
    assert main(["calibrate", str(session)]) == 2
    printed = capsys.readouterr().err
    assert "9 x 7" in printed and "9 x 6" in printed and "board file" in printed

    board.write_text(BOARD)
    whole = (session.parent / "02.jpg").read_bytes()
    (session.parent / "02.jpg").write_bytes(whole[: len(whole) // 2])
    assert main(["calibrate", str(session)]) == 2
    assert "02.jpg" in capsys.readouterr().err
    # The others are calibrated from: the result is there, the exit code says that it is not of all.
    assert len(load_calibration(session.parent / "calibration.json").views) == 4

    session.write_text(SESSION.replace("*.jpg", "*.tif"))
    (session.parent / "corners.json").unlink(missing_ok=True)
    assert main(["calibrate", str(session), "--force"]) == 2
    assert "no image matches" in capsys.readouterr().err


def test_paths_with_brackets_blanks_and_umlauts(session: Path) -> None:
    folder = session.parent / "Messung ä 測 [1]"
    folder.mkdir()
    for path in (*session.parent.glob("*.jpg"), session, session.parent / "board.toml"):
        path.rename(folder / path.name)
    (folder / "04.jpg").rename(folder / "Bild [4].jpg")
    (folder / "session.toml").write_text(SESSION.replace('"*.jpg"', '["0*.jpg", "Bild [4].jpg"]'), encoding="utf-8")
    assert main(["calibrate", str(folder / "session.toml")]) == 0
    assert len(load_calibration(folder / "calibration.json").views) == 5


def test_images_of_one_name_in_two_folders(session: Path) -> None:
    for k, path in enumerate(sorted(session.parent.glob("*.jpg"))):
        folder = session.parent / f"day{k % 2}"
        folder.mkdir(exist_ok=True)
        path.rename(folder / f"{k // 2}.jpg")
    session.write_text(SESSION.replace('"*.jpg"', '"day*/*.jpg"'))
    assert main(["calibrate", str(session), "--report"]) == 0
    assert (session.parent / "calibration.html").read_text().count("data:image/jpeg") == 5
    views = load_calibration(session.parent / "calibration.json").views
    assert sorted(v.image for v in views) == ["2.jpg", "day0/0.jpg", "day0/1.jpg", "day1/0.jpg", "day1/1.jpg"]


def test_a_disk_that_fills_up_leaves_all_files_as_they_were(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", str(session), "--report"]) == 0
    before = {path.name: path.read_bytes() for path in session.parent.iterdir()}
    fill = writing._fill

    def until_the_page(handle: int, data: bytes) -> None:
        if data.startswith(b"<!"):
            os.close(handle)
            raise OSError(28, "No space left on device")
        fill(handle, data)

    monkeypatch.setattr(writing, "_fill", until_the_page)
    session.write_text(SESSION.replace("kannala_brandt", "eucm"))
    before["session.toml"] = session.read_bytes()
    assert main(["calibrate", str(session), "--report", "--force"]) == 2
    words = "calibration.html': No space left on device; all 2 files of this step stay as they were"
    assert words in capsys.readouterr().err
    after = {path.name: path.read_bytes() for path in session.parent.iterdir()}
    # The kept corners are now those seen through the other lens.
    assert after.pop("corners.json") != before.pop("corners.json") and after == before


def test_session_where_nothing_can_be_written(
    session: Path,
    tmp_path_factory: pytest.TempPathFactory,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A capture on a read-only medium: the result goes elsewhere, only the corners are not kept."""
    allowed = os.access

    def access(path: str | Path, mode: int) -> bool:
        return not (Path(path) == session.parent and mode & os.W_OK) and allowed(path, mode)

    monkeypatch.setattr(os, "access", access)
    target = tmp_path_factory.mktemp("elsewhere") / "calibration.json"
    assert main(["calibrate", str(session), "-o", str(target.with_suffix(""))]) == 0
    assert "not kept" in capsys.readouterr().err
    assert target.is_file() and not (session.parent / "corners.json").exists()


def test_folders_are_skipped_and_missing_images_named(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder that the pattern meets is passed over; a listed image that is not there is a mistake."""
    (session.parent / "old.jpg").mkdir()
    assert main(["calibrate", str(session)]) == 0
    session.write_text(SESSION.replace('"*.jpg"', '["0*.jpg", "gone.jpg"]'))
    assert main(["calibrate", str(session), "--force"]) == 2
    assert "gone.jpg" in capsys.readouterr().err


def test_damaged_corners_are_found_again(session: Path) -> None:
    assert main(["calibrate", str(session)]) == 0
    kept = session.parent / "corners.json"
    good = kept.read_text()
    for bad in (good[: len(good) // 2], "[]", '{"images": 3}', good.replace('"sigma_px": [', '"sigma_px": [NaN, ', 1)):
        kept.write_text(bad)
        cache = CornerCache(kept, load_session(session).boards)
        assert cache.images == []
    assert main(["calibrate", str(session), "--force"]) == 0
    assert json.loads(kept.read_text()) == json.loads(good)


def test_image_of_another_size_is_dropped_with_the_reason(session: Path) -> None:
    path = session.parent / "01.jpg"
    write_half(path, path)
    assert main(["calibrate", str(session)]) == 0
    result = load_calibration(session.parent / "calibration.json")
    assert [image for image, _ in result.dropped] == ["01.jpg"]
    assert "406x310" in result.dropped[0][1]
    # Nor does it have the corners of the others found again every time.
    corners = (session.parent / "corners.json").read_bytes()
    assert main(["calibrate", str(session), "--force"]) == 0
    assert (session.parent / "corners.json").read_bytes() == corners


@pytest.mark.parametrize(
    ("model", "degree", "printed"),
    [
        ("scaramuzza", 99, "scaramuzza has no degree 99; choose 3, 4, 5, 6, 7, 8, 9, 10"),
        ("brown", 6, "brown has no degree 6; choose 4, 5, 8"),
        ("kannala_brandt", 4, "degree 4 for kannala_brandt, which has one size only; remove it"),
        ("auto", 6, 'degree 6 with model = "auto", which chooses by itself'),
        ("scaramuzza", 0, "'degree' must be at least 1"),
    ],
)
def test_impossible_degrees_are_refused(
    session: Path, capsys: pytest.CaptureFixture[str], model: str, degree: int, printed: str
) -> None:
    session.write_text(SESSION.replace("kannala_brandt", model) + f"degree = {degree}\n")
    assert main(["calibrate", str(session)]) == 2
    error = capsys.readouterr().err
    assert printed in error and str(session) in error


@pytest.mark.parametrize(
    ("line", "printed"),
    [
        ("columns = 9000", "'columns' is 9000, more than 1000"),
        ("square_mm = 0.03", "write mm"),
        ("square_mm = inf", "must be a finite number"),
        ("rows = 1", "at least 2x2 inner corners"),
    ],
)
def test_impossible_boards_are_refused(
    session: Path, capsys: pytest.CaptureFixture[str], line: str, printed: str
) -> None:
    board = session.parent / "board.toml"
    key = line.split()[0]
    board.write_text("\n".join(line if row.startswith(key) else row for row in board.read_text().splitlines()))
    assert main(["calibrate", str(session)]) == 2
    assert printed in capsys.readouterr().err


def test_images_of_two_sizes(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_half(session.parent / "04.jpg", session.parent / "04.jpg")
    assert main(["calibrate", str(session)]) == 0
    assert (
        "look: image '04.jpg' is left out: 406x310 px, most images with boards have 812x620" in capsys.readouterr().out
    )
    write_half(session.parent / "03.jpg", session.parent / "03.jpg")
    assert main(["calibrate", str(session), "--force"]) == 2
    error = capsys.readouterr().err
    assert "812x620 px (3, such as '00.jpg') and 406x310 px (2, such as '03.jpg')" in error
    assert "in a folder of their own" in error


def test_large_squares_through_a_small_fisheye(tmp_path: Path) -> None:
    """A few squares that each turn a line by ten degrees do not say how it bends; the lens does, once it is known."""
    camera = KannalaBrandt((640, 480), np.array([190.0, 190.0, 325.3, 236.1, -0.03, 0.004, -0.001, 0.0]))
    board = Board("board", 6, 5, 50.0, 50.0)
    rng = np.random.default_rng(4)
    count, seen = 0, []
    while count < 10:
        angle, radius = 2.4 * count + rng.normal(), (0.0, 100.0, 150.0)[count % 3]
        spot = np.array([320.0 + 1.2 * radius * np.cos(angle), 240.0 + radius * np.sin(angle)])
        placed = place_board(board, camera, spot, rng.uniform(28.0, 42.0), 45.0, rng)
        if placed is None or not sees_paper(placed, camera, (0.0, 0.0), camera.size_px):
            continue
        optics, photometry = Optics(0.7, field_deg=190.0, supersample=2), Photometry(noise_levels=2.0)
        image = render([placed], camera, Rigid3.identity(), optics=optics, photometry=photometry, rng=rng)
        cv2.imwrite(str(tmp_path / f"{count:02d}.png"), image)
        seen.append(placed.see(camera, Rigid3.identity())[0])
        count += 1
    (tmp_path / "board.toml").write_text(
        'schema = "rigkit.board/1"\nid = "board"\ncolumns = 6\nrows = 5\nsquare_mm = 50.0\n'
    )
    (tmp_path / "session.toml").write_text(SESSION.replace("*.jpg", "*.png"))
    assert main(["calibrate", str(tmp_path / "session.toml")]) == 0
    found = load_calibration(tmp_path / "calibration.json").camera
    pixels = np.concatenate(seen)
    rays, ours = camera.unproject(pixels)[0], found.unproject(pixels)[0]
    projected, _ = found.project(rays @ nearest_rotation(ours.T @ rays).T)
    # 0.016 px from the corners as they are found without the lens, 0.002 with it.
    assert np.sqrt(((projected - pixels) ** 2).sum(axis=1).mean()) < 0.005


def test_the_first_camera_is_of_a_model_that_fits(tmp_path: Path) -> None:
    """Scaramuzza's model does not follow such a lens: looked at through it corners seemed to be off by up to 4 px, and
    their sigmas came out four times too large."""
    camera = Brown((816, 682), np.array([417.0, 417.3, 437.0, 312.0, -0.30, 0.11, 8e-4, -5e-4, -0.018]))
    board = Board("board", 9, 6, 25.0, 25.0)
    views, _, _ = random_views(camera, 9, np.random.default_rng(5), reach_deg=45.0, board=board, noise_px=0.01)
    found = {
        v.image: FoundCorners(camera.size_px, (BoardDetection("board", *board.size, v.grid, v.pixels, v.sigma_px),))
        for v in views
    }
    (tmp_path / "board.toml").write_text('id = "board"\n' + BOARD.replace("30.0", "25.0"))
    path = tmp_path / "session.toml"
    path.write_text(SESSION.replace("kannala_brandt", "auto"))
    first = first_calibration(load_session(path), found)
    assert first is not None and first.camera.model == "brown"
    path.write_text(SESSION.replace("kannala_brandt", "scaramuzza"))
    named = first_calibration(load_session(path), found)
    assert named is not None and named.camera.model == "scaramuzza"
