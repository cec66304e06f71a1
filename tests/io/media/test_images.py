"""Image files: pixels of every format unchanged, and damaged or truncated files."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest

from rigkit.core.errors import InputError
from rigkit.io.media.images import (
    folder_of_images,
    images_below,
    images_of_folder,
    no_images,
    quiet_opencv,
    read_image,
    to_grey,
)
from rigkit.workflows.detect import images_in
from rigkit.workflows.inputs.folder_session import images_of_camera


@pytest.fixture
def colour(rng: np.random.Generator) -> np.ndarray:
    """Red, green, blue noise, hard to compress: files of every format are long enough to be cut."""
    return rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)


def save(path: Path, image: np.ndarray, *options: int) -> bytes:
    ok, data = cv2.imencode(path.suffix, image[..., ::-1] if image.ndim == 3 else image, options)
    assert ok
    path.write_bytes(data.tobytes())
    return data.tobytes()


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".ppm"])
def test_pixels_come_back_as_red_green_blue(tmp_path: Path, colour: np.ndarray, suffix: str) -> None:
    save(tmp_path / f"a{suffix}", colour)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}"), colour)


def test_grey_16_bit_and_alpha(tmp_path: Path, colour: np.ndarray) -> None:
    deep = colour[..., 0].astype(np.uint16) * 257
    save(tmp_path / "deep.png", deep)
    found = read_image(tmp_path / "deep.png")
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, deep)
    blue_first = np.dstack([colour[..., ::-1], np.full((60, 80), 7, np.uint8)])
    (tmp_path / "alpha.png").write_bytes(cv2.imencode(".png", blue_first)[1].tobytes())
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), colour)


def test_grey_of_colour_is_its_luma(colour: np.ndarray) -> None:
    grey = to_grey(colour)
    assert grey.dtype == np.uint8
    # Rounded to whole grey values.
    np.testing.assert_allclose(grey, colour @ [0.299, 0.587, 0.114], atol=1.0)
    assert to_grey(grey) is grey
    assert to_grey(colour.astype(np.uint16) * 257).dtype == np.uint16
    with pytest.raises(InputError, match="shape"):
        to_grey(np.zeros((4, 4, 2), np.uint8))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif", ".ppm", ".webp"])
@pytest.mark.parametrize("part", [0.2, 0.9, 0.99])
def test_cut_off_images_are_refused_in_one_line(
    tmp_path: Path, colour: np.ndarray, suffix: str, part: float, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"a{suffix}"
    data = save(path, colour)
    path.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(InputError, match=f"a{suffix}") as caught:
        read_image(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_a_jpeg_whose_rest_is_zeros_is_cut_off(tmp_path: Path, colour: np.ndarray) -> None:
    data = save(tmp_path / "a.jpg", colour)
    (tmp_path / "a.jpg").write_bytes(data[:2000] + bytes(len(data) - 2000))
    with pytest.raises(InputError, match="cut off"):
        read_image(tmp_path / "a.jpg")


def test_whole_jpegs_of_every_kind_are_read(tmp_path: Path, colour: np.ndarray) -> None:
    plain = save(tmp_path / "plain.jpg", colour)
    save(tmp_path / "progressive.jpg", colour, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    save(tmp_path / "restart.jpg", colour, cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
    # Bytes after the end, and a thumbnail with its own end marker in front, as cameras write them.
    (tmp_path / "trailing.jpg").write_bytes(plain + b"maker notes")
    segment = b"\xff\xe1" + (len(plain) + 2).to_bytes(2, "big") + plain
    (tmp_path / "thumbnail.jpg").write_bytes(plain[:2] + segment + plain[2:])
    expected = read_image(tmp_path / "plain.jpg")
    for name in ("progressive", "restart", "trailing", "thumbnail"):
        np.testing.assert_array_equal(read_image(tmp_path / f"{name}.jpg"), expected)
    # Cut after the thumbnail's end marker: that one must not count.
    (tmp_path / "thumbnail.jpg").write_bytes(plain[:2] + segment + plain[2 : len(plain) // 2])
    with pytest.raises(InputError, match="cut off"):
        read_image(tmp_path / "thumbnail.jpg")


def test_orientation_in_exif_is_not_applied(tmp_path: Path, colour: np.ndarray) -> None:
    plain = save(tmp_path / "a.jpg", colour)
    tiff = b"II*\x00\x08\x00\x00\x00\x01\x00\x12\x01\x03\x00\x01\x00\x00\x00\x06\x00\x00\x00\x00\x00\x00\x00"
    exif = b"Exif\x00\x00" + tiff
    (tmp_path / "turned.jpg").write_bytes(
        plain[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + plain[2:]
    )
    turned = cv2.imread(str(tmp_path / "turned.jpg"))
    assert turned is not None and turned.shape == (80, 60, 3)
    np.testing.assert_array_equal(read_image(tmp_path / "turned.jpg"), read_image(tmp_path / "a.jpg"))


def test_a_changed_byte_in_a_png_is_found(tmp_path: Path, colour: np.ndarray) -> None:
    data = bytearray(save(tmp_path / "a.png", colour))
    data[len(data) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        read_image(tmp_path / "a.png")


def test_files_that_are_no_images_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_image(tmp_path / "none.jpg")
    with pytest.raises(InputError, match="folder"):
        read_image(tmp_path)
    (tmp_path / "empty.png").touch()
    with pytest.raises(InputError, match="empty"):
        read_image(tmp_path / "empty.png")
    (tmp_path / "text.jpg").write_text("not an image")
    with pytest.raises(InputError, match="not an image"):
        read_image(tmp_path / "text.jpg")
    cv2.imwrite(str(tmp_path / "real.tif"), np.zeros((4, 4), np.float32))
    with pytest.raises(InputError, match="float32"):
        read_image(tmp_path / "real.tif")


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("big", "deep"), [(False, False), (True, False), (False, True)])
def test_an_orientation_is_not_applied(
    tmp_path: Path, colour: np.ndarray, orientation: int, big: bool, deep: bool
) -> None:
    """A calibration belongs to the sensor, however the camera was held."""
    pixels = colour[..., 0].astype(np.uint16) * 257 if deep else colour
    for name, options in (("a.tif", {"big_tiff": big}), ("a.png", {}), ("a.jpg", {"quality": 100, "subsampling": 0})):
        if deep and name == "a.jpg":
            continue
        exif = PIL.Image.Exif()
        exif[0x0112] = orientation
        PIL.Image.fromarray(pixels).save(tmp_path / name, exif=exif, **options)
        found = read_image(tmp_path / name)
        # What a JPEG loses of noise at full quality.
        np.testing.assert_allclose(found, pixels, atol=8 if name == "a.jpg" else 0)


def test_several_pages_are_refused_previews_are_not(tmp_path: Path, colour: np.ndarray) -> None:
    first, *others = (PIL.Image.fromarray(np.roll(colour, k, axis=0)) for k in range(3))
    first.save(tmp_path / "stack.tif", save_all=True, append_images=others)
    with pytest.raises(InputError, match=r"stack.tif' holds 3 pages"):
        read_image(tmp_path / "stack.tif")
    first.save(tmp_path / "preview.tif", save_all=True, append_images=[first.resize((20, 15))])
    np.testing.assert_array_equal(read_image(tmp_path / "preview.tif"), colour)


def test_damaged_directories_of_a_tiff_end_in_words(
    tmp_path: Path, colour: np.ndarray, rng: np.random.Generator
) -> None:
    data = save(tmp_path / "a.tif", colour)
    start = int.from_bytes(data[4:8], "little")
    for _ in range(200):
        spoilt = bytearray(data)
        for at in rng.integers(start, len(data), 3):
            spoilt[at] = rng.integers(256)
        (tmp_path / "b.tif").write_bytes(spoilt)
        try:
            read_image(tmp_path / "b.tif")
        except InputError as error:
            assert "b.tif" in str(error)
    # A directory that is its own successor.
    entries = int.from_bytes(data[start : start + 2], "little")
    end = start + 2 + 12 * entries
    (tmp_path / "b.tif").write_bytes(data[:end] + start.to_bytes(4, "little") + data[end + 4 :])
    np.testing.assert_array_equal(read_image(tmp_path / "b.tif"), colour)


def test_opencv_is_quiet_in_either_of_its_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV 4 has the two functions at its top, OpenCV 5 in a module of their own."""
    levels = [3]
    for name in ("getLogLevel", "setLogLevel"):
        monkeypatch.setattr(
            cv2, name, {"getLogLevel": lambda: levels[-1], "setLogLevel": levels.append}[name], raising=False
        )
    monkeypatch.delattr(cv2.utils, "logging", raising=False)
    with quiet_opencv():
        assert levels[-1] == 0
    assert levels[-1] == 3


def test_pictures_of_a_format_that_is_not_read_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Half of a phone's pictures in another format would be missed without a word; of raw and JPEG nothing is."""
    for name in ("1.jpg", "1.CR2", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert list(images_in([tmp_path])) == [tmp_path / "1.jpg"] and not caplog.records
    for name in ("2.heic", "3.HEIC"):
        (tmp_path / name).write_bytes(b"")
    assert list(images_in([tmp_path])) == [tmp_path / "1.jpg"]
    assert "2 pictures, '2.heic' the first, are of a format that is not read" in caplog.text


def test_a_folder_without_images_says_what_it_holds_instead(tmp_path: Path) -> None:
    assert no_images(tmp_path).endswith("; give another")
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "a.PNG").touch()
        if day == "monday":
            assert folder_of_images(tmp_path) == tmp_path / "monday"
    words = no_images(tmp_path)
    assert words.endswith(f"are in '{tmp_path / 'monday'}' and 1 more below it; give one folder a camera")
    (tmp_path / "a.jp2").touch()
    assert "formats that are not read, 'a.jp2' the first" in no_images(tmp_path)
    (tmp_path / "tuesday" / "a.PNG").unlink()
    with pytest.raises(InputError, match="formats that are not read"):
        folder_of_images(tmp_path)


def test_hidden_files_are_no_images(tmp_path: Path) -> None:
    """A Mac writes ._a.jpg beside a.jpg on disks that cannot hold its attributes, and programs keep thumbnails."""
    for name in ("a.jpg", "._a.jpg", ".thumbnails/a.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    own = [tmp_path / "a.jpg"]
    assert images_of_folder(tmp_path) == images_below(tmp_path) == list(images_in([tmp_path])) == own
    assert images_of_camera([(tmp_path, "*.jpg")]) == own


def test_links_to_folders_are_followed_once(tmp_path: Path) -> None:
    for name in ("disk/a/1.jpg", "disk/b/1.jpg", "session/c/1.jpg"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    session = tmp_path / "session"
    for name, target in (("left", "disk/a"), ("right", "disk/b"), ("c/up", "session"), ("also", "session/c")):
        (session / name).symlink_to(tmp_path / target, target_is_directory=True)
    assert images_below(session) == [session / "c" / "1.jpg", session / "left" / "1.jpg", session / "right" / "1.jpg"]


def test_an_unreadable_subfolder_is_named_and_does_not_end_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As in /proc, whose folders of processes vanish while they are read."""
    (tmp_path / "gone").mkdir()
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "1.png"), np.zeros((2, 2), np.uint8))
    scandir = os.scandir

    def refuse(path: str) -> object:
        if Path(path).name == "gone":
            raise OSError(22, "Invalid argument", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    assert folder_of_images(tmp_path) == tmp_path / "images"
    assert f"folder '{tmp_path / 'gone'}' cannot be read and is left out: Invalid argument" in caplog.text
