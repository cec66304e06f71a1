"""Hostile files and paths are refused with a message; each of these once ended in a traceback, an endless read or a
wrong result."""

from __future__ import annotations

import io
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from rigkit.core.arrays import as_array, as_covariance
from rigkit.core.boards import Board
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import InputError, InternalError
from rigkit.core.identifiers import MAX_IDENTIFIER, check_identifier
from rigkit.io.boards.board_file import load_board
from rigkit.io.calibrations.calibration_file import load_camera
from rigkit.io.calibrations.rig_file import load_rig
from rigkit.io.corners.correspondences import read_correspondences
from rigkit.io.disk.json_reader import positive
from rigkit.io.disk.reading import read_bytes, read_text
from rigkit.io.disk.toml_reader import TomlTable
from rigkit.io.manifests.manifest import load_dataset
from rigkit.io.media.images import announced_sizes, read_image
from rigkit.io.ply import ply_bytes, read_ply

BOARD = 'schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n'
CAMERA = {
    "model": "pinhole",
    "size_px": [640, 480],
    "parameters": {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0},
}


def test_ordinary_files_are_read(tmp_path: Path) -> None:
    """Nothing below is refused for another reason."""
    (tmp_path / "b.toml").write_text(BOARD)
    assert load_board(tmp_path / "b.toml").size == (9, 6)
    (tmp_path / "c.json").write_text(json.dumps({"schema": "rigkit.calibration/1", "camera": CAMERA}))
    assert load_camera(tmp_path / "c.json").size_px == (640, 480)


@pytest.mark.parametrize(
    "damage",
    [
        "square_sigma_mm = " + "9" * 400,
        "square_sigma_mm = " + "9" * 5000,
        "square_sigma_mm = 1e-300",
        "square_sigma_mm = 1e300",
        "square_sigma_mm = true",
        'square_sigma_mm = "0.1"',
        "a = " + "[" * 3000,
        'id = "a\\u0000b"',
        'id = "a\\nb"',
        'id = "=1+1"',
        'id = "<!--<script>"',
        'id = "' + "x" * 300 + '"',
        "first_marker = " + "9" * 400,
    ],
)
def test_tables_of_people(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "board.toml"
    path.write_text(BOARD + damage + "\n")
    with pytest.raises(InputError) as caught:
        load_board(path)
    assert "board.toml" in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 600


@pytest.mark.parametrize("name", ["a\0b", "x" * 256, "loop", "pipe", "/dev/zero", "folder", "absent"])
def test_paths(tmp_path: Path, name: str) -> None:
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    path = f"{tmp_path}/{name}" if name[0] != "/" else name
    readers = (load_board, load_camera, load_rig, load_dataset, read_image, read_ply, read_correspondences, read_text)
    for read in readers:
        with pytest.raises(InputError) as caught:
            read(path)
        assert ";" in str(caught.value) and "\0" not in str(caught.value)


def test_a_path_is_shown_as_it_is_written(tmp_path: Path) -> None:
    """Not as what its links lead to, which a person may never have seen; `..` of a link is where it leads to."""
    for name in ("here", "far/store", "far/other"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "far/store/b.toml").write_text(BOARD + "x = 1\n")
    (tmp_path / "far/other/b.toml").write_text(BOARD)
    (tmp_path / "here/boards").symlink_to(tmp_path / "far/store")
    table = TomlTable({}, {}, tmp_path / "here/session.toml")
    assert table.path_of("boards/b.toml") == tmp_path / "here/boards/b.toml"
    assert load_board(table.path_of("boards/../other/b.toml")).size == (9, 6)
    with pytest.raises(InputError, match="here/boards"):
        load_board(table.path_of("boards/b.toml"))


def test_a_file_has_a_size_that_it_may_have(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"12345")
    assert read_bytes(tmp_path / "f", max_bytes=5) == b"12345"
    with pytest.raises(InputError, match="5 bytes, more than 4"):
        read_bytes(tmp_path / "f", max_bytes=4)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("640", "640.5"),
        ("640", "true"),
        ("640", '"640"'),
        ("640", "1e12"),
        ("640", "9" * 400),
        ("640", "9" * 5000),
        ('"fx": 500.0', '"fx": true'),
        ('"fx": 500.0', '"fx": "500"'),
        ('"fx": 500.0', '"fx": 1e300'),
        ('"fx": 500.0', '"fx": 1e999'),
        ('"fx": 500.0', '"fx": NaN'),
        ('"fx": 500.0', '"fx": 400.0, "fx": 500.0'),
        ('"fx": 500.0', '"fx": ' + "[" * 100_000),
        ('"pinhole"', '["pinhole"]'),
        ('"fx": 500.0', '"fx": -500.0'),
        ('"fx": 500.0', '"fx": 1e-5'),
        ('"fx": 500.0', '"fx": 1e9'),
        ('"fx": 500.0', '"fx": 1.0'),
        ('"cx": ', '"cx": 1e8, "x": '),
    ],
)
def test_cameras(tmp_path: Path, old: str, new: str) -> None:
    text = json.dumps({"schema": "rigkit.calibration/1", "camera": CAMERA})
    assert old in text
    (tmp_path / "c.json").write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_camera(tmp_path / "c.json")
    assert "c.json" in str(caught.value) and "\n" not in str(caught.value)


def test_two_cameras_of_one_name(tmp_path: Path) -> None:
    entry = {"name": "a", "camera": CAMERA, "cam_from_rig": np.eye(4)[:3].tolist(), "rms_px": 0.1}
    data = {"schema": "rigkit.rig/1", "cameras": [entry, entry]}
    (tmp_path / "rig.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match="two cameras are called 'a'"):
        load_rig(tmp_path / "rig.json")


def test_covariances(rng: np.random.Generator) -> None:
    half = rng.normal(size=(5, 5)) * 10.0 ** rng.integers(-10, 4, 5)[:, None]
    good = half @ half.T
    assert as_covariance(good, "c", 5).shape == (5, 5)
    # A problem that does not determine one direction leaves a zero that rounding may make negative.
    assert as_covariance(np.outer(half[:, 0], half[:, 0]), "c", 5) is not None
    changed = np.diag([1e-4, 1e-26])
    for damage in ([(0, 1, 1e-8)], [(0, 1, 1e-8), (1, 0, 1e-8)], [(0, 0, -1.0)], [(0, 0, np.nan)], [(1, 1, np.inf)]):
        bad = changed.copy()
        for row, column, value in damage:
            bad[row, column] = value
        with pytest.raises(InputError):
            as_covariance(bad, "c", 2)
    with pytest.raises(InputError, match="negative variance"):
        as_covariance(1.9 * np.eye(3) - 0.9, "c", 3)
    with pytest.raises(InputError, match="shape"):
        as_covariance(np.eye(3), "c", 2)
    # What is held may be taken as exact, all of a calibration may not.
    assert as_covariance(np.diag([0.0, 1.0]), "c", 2) is not None
    with pytest.raises(InputError, match="every variance is zero"):
        as_covariance(np.zeros((2, 2)), "c", 2)


@pytest.mark.parametrize("value", [[True, False], ["1", "2"], [b"1", b"2"]])
def test_words_and_truth_values_are_no_numbers(value: list[object]) -> None:
    with pytest.raises(InputError, match="not an array of numbers"):
        as_array(value, (2,), "x")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "name", ["", "a\nb", "a/b", "..", "-a", "=1", "a<b", "a\x1b[0m", "a" * (MAX_IDENTIFIER + 1), "a "]
)
def test_what_is_no_name(name: str) -> None:
    with pytest.raises(InputError):
        check_identifier(name, "board")


def test_names_of_all_scripts() -> None:
    for name in ("plane1", "a9x6_30", "fisheye-forward", "tábla 1 (új)", "板1", "v1.2+b", "_1"):
        assert check_identifier(name, "board") == name


def test_a_name_stays_on_its_line_of_a_header(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        Board("a\nb", 4, 3, 10.0, 10.0)
    cloud = OrientedCloud(
        points_mm=np.zeros((1, 3)),
        normals=np.array([[0.0, 0.0, -1.0]]),
        colours=np.zeros((1, 3), np.uint8),
        board_index=np.zeros(1, int),
        grid=np.zeros((1, 2), int),
        sigma_mm=np.ones(1),
        normal_sigma_rad=np.ones(1),
        board_ids=("a\nend_header\n",),
    )
    (tmp_path / "c.ply").write_bytes(ply_bytes(cloud, comments=["x\ny\x1b"]))
    assert len(read_ply(tmp_path / "c.ply")) == 1


def test_a_property_twice(tmp_path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n"
    (tmp_path / "c.ply").write_bytes(head.encode() + bytes(8))
    with pytest.raises(InputError, match="'x' is declared twice"):
        read_ply(tmp_path / "c.ply")


def _npy(header: str, data: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + data


@pytest.mark.parametrize(
    "member",
    [
        _npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 2), }\n"),
        _npy("{'descr': '<f8', 'fortran_order': False, 'shape': (), }\n", bytes(8)),
        _npy("{'descr': '|O', 'fortran_order': False, 'shape': (1, 2), }\n", bytes(8)),
        _npy("{'descr': '|b1', 'fortran_order': False, 'shape': (1, 2), }\n", bytes(2)),
        _npy("nonsense"),
        b"",
    ],
)
def test_arrays_of_correspondences(tmp_path: Path, member: bytes) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in ("pixels1", "pixels2"):
            archive.writestr(f"{name}.npy", member)
    (tmp_path / "m.npz").write_bytes(stream.getvalue())
    with pytest.raises(InputError, match=r"m\.npz"):
        read_correspondences(tmp_path / "m.npz")


def test_a_damaged_archive(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, pixels1=np.arange(80.0).reshape(-1, 2), pixels2=np.ones((40, 2)))
    data = bytearray(stream.getvalue())
    refused = 0
    for at in range(60, 120, 3):
        broken = data.copy()
        broken[at] ^= 0xFF
        (tmp_path / "m.npz").write_bytes(bytes(broken))
        try:
            # Not every byte of an archive says something.
            assert read_correspondences(tmp_path / "m.npz").pixels1[-1].tolist() == [78.0, 79.0]
        except InputError as error:
            refused += 1
            assert "m.npz" in str(error)
    assert refused > 10


def test_a_number_that_overflows(tmp_path: Path) -> None:
    text = "u1_px,v1_px,u2_px,v2_px,a11,a12,a21,a22\n1,2,3,4,1,1e160,0,1\n"
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputError, match="beyond"):
        read_correspondences(tmp_path / "m.csv")


@pytest.mark.parametrize("ending", ["gif", "png", "webp"])
def test_animations(tmp_path: Path, ending: str, rng: np.random.Generator) -> None:
    frames = [rng.integers(0, 255, (40, 60, 3), dtype=np.uint8) for _ in range(3)]
    path = tmp_path / f"a.{ending}"
    animation = cv2.Animation()
    animation.frames, animation.durations = frames, [100, 100, 100]
    if not cv2.imwriteanimation(str(path), animation):
        pytest.skip(f"this OpenCV writes no animated {ending}")
    with pytest.raises(InputError, match="animation of 3 frames"):
        read_image(path)
    cv2.imwrite(str(path), frames[0])
    assert read_image(path).shape[:2] == (40, 60)


def test_a_message_is_one_line() -> None:
    """Whatever a file's name or a value has in it; only a fault of ours comes with its lines."""
    assert str(InputError("image 'a\nb\x1b[31m\udcff.png' is empty; ü")) == (
        "image 'a\\nb\\x1b[31m\\udcff.png' is empty; ü"
    )
    assert str(InternalError("Traceback:\n here")).count("\n") == 1


def _head_of_png(width: int, height: int) -> bytes:
    head = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    chunks = [head, b"IDAT" + zlib.compress(bytes(100)), b"IEND"]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        (len(c) - 4).to_bytes(4, "big") + c + zlib.crc32(c).to_bytes(4, "big") for c in chunks
    )


def _claiming(ending: str, *pairs: tuple[bytes, bytes]) -> bytes:
    """A small image whose head says 30000 x 30000 px; `pairs` are its sides, as the format writes them."""
    data = bytes(cv2.imencode(f".{ending}", np.zeros((41, 63, 3), np.uint8))[1])
    for small, large in pairs:
        assert small in data
        data = data.replace(small, large)
    return data


def _sides(*sides: int, size: int, order: Literal["little", "big"]) -> tuple[bytes, bytes]:
    return b"".join(n.to_bytes(size, order) for n in sides), (30_000).to_bytes(size, order) * 2


HEADS = {
    "png": _head_of_png(30_000, 30_000),
    "bmp": _claiming("bmp", _sides(63, 41, size=4, order="little")),
    "pgm": b"P5\n# a comment\n30000 30000\n255\nabc",
    "pam": b"P7\nWIDTH 30000\nHEIGHT 30000\nDEPTH 1\nMAXVAL 255\nENDHDR\nabc",
    "pfm": b"Pf\n30000 30000\n1.0\nabc",
    "hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 30000\nabc",
    "gif": _claiming("gif", _sides(63, 41, size=2, order="little")),
    "jp2": _claiming("jp2", _sides(63, 41, size=4, order="big"), _sides(41, 63, size=4, order="big")),
}
UNREAD = ("hdr", "pam")
"""Pillow does not know them, and no camera writes them."""


@pytest.mark.parametrize("ending", sorted(HEADS))
def test_an_image_of_too_many_pixels(tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused before a decoder makes room for it."""
    (tmp_path / f"a.{ending}").write_bytes(HEADS[ending])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    words = "not an image that is read" if ending in UNREAD else "30000 x 30000 px, more than"
    with pytest.raises(InputError, match=rf"a\.{ending}'.*{words}"):
        read_image(tmp_path / f"a.{ending}")


@pytest.mark.parametrize(
    "ending", ["png", "jpg", "bmp", "pgm", "ppm", "pam", "webp", "tif", "gif", "jp2", "ras", "avif"]
)
@pytest.mark.parametrize("colour", [False, True])
def test_the_size_that_a_file_announces_is_that_of_its_image(ending: str, colour: bool) -> None:
    image = np.zeros((41, 63, 3) if colour else (41, 63), np.uint8)
    image[5:20, 7:30] = 255
    try:
        done, data = cv2.imencode(f".{ending}", image)
    except cv2.error:
        done = False
    if not done:
        pytest.skip(f"this OpenCV writes no {ending}")
    assert announced_sizes(data.tobytes()) == ([(63, 41)] if ending not in UNREAD else [])


def test_one_pixel_less_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 60), np.uint8))
    monkeypatch.setattr("rigkit.io.media.images.MAX_PIXELS", 40 * 60)
    assert read_image(tmp_path / "a.png").shape == (40, 60)
    monkeypatch.setattr("rigkit.io.media.images.MAX_PIXELS", 40 * 60 - 1)
    with pytest.raises(InputError, match="60 x 40"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("value", [0.0, -1.0, 1e-300])
def test_what_must_be_positive(value: float) -> None:
    assert positive(0.5) == 0.5
    with pytest.raises(ValueError, match="must be positive"):
        positive(value)
