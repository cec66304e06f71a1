"""`rigkit calibrate FOLDER` refuses sizes of squares that mean nothing, and what is no folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.cli.main import main


@pytest.mark.parametrize(
    ("reported", "words"),
    [
        (["--square-mm", "nan"], "a positive number of mm"),
        (["--square-mm", "30", "--board", "9x6x30"], "leave --square-mm out"),
    ],
)
def test_an_unusable_square_size_is_refused(
    reported: list[str], words: str, pictures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", str(pictures), *reported]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("options", [(), ("--board", "9x6x30"), ("--square-mm", "25")])
def test_a_missing_folder_is_named(
    options: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", str(tmp_path / "photos"), *options]) == 2
    assert f"'{tmp_path / 'photos'}' does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("options", [(), ("--board", "9x6x30"), ("--square-mm", "25"), ("--cameras", "1")])
def test_images_instead_of_their_folder(
    options: tuple[str, ...], pictures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a shell expands photos/*.jpg."""
    images = [str(path) for path in sorted(pictures.glob("left*.jpg"))]
    for given in (images[:1], images):
        assert main(["calibrate", *given, *options]) == 2
        assert capsys.readouterr().err.endswith(
            f"'{images[0]}' is an image; give the folder that holds it instead, '{pictures}'\n"
        )


def test_a_folder_to_write_is_refused(pictures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in (pictures, pictures / "new"):
        assert main(["calibrate", str(pictures), "--board", "9x6x30", "-o", f"{folder}/"]) == 2
        assert capsys.readouterr().err.endswith(f"give a file, such as '{folder / 'calibration.json'}'\n")
    assert not (pictures / "new.json").exists()


def test_a_file_without_suffix_that_exists_is_not_another_name(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Such as /dev/null, beside which nothing is to be written."""
    there = tmp_path / "there"
    there.touch()
    assert main(["calibrate", str(pictures), "--board", "9x6x30", "-o", str(there)]) == 2
    assert f"'{there}' exists and is left as it is" in capsys.readouterr().err
    # A board that cannot be is told first.
    assert main(["calibrate", str(pictures), "--board", "9x6y30", "-o", str(there)]) == 2
    assert "--board 9x6y30: write 9x6x25" in capsys.readouterr().err
