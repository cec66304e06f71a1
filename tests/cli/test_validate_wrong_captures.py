"""Captures with one fault, RENDERED, through `rigkit validate`: the right check fails and names it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from helpers.trihedral_captures import BOARDS, pair_toml, write_manifest

from rigkit.cli.main import main
from rigkit.synthetic.pairs import StereoScene

Trihedral = tuple[Path, dict[str, StereoScene]]


@pytest.fixture
def folder(trihedral: Trihedral, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trihedral[0], tmp_path / "capture"))


def validate(folder: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, str, set[str]]:
    """Return the exit code, all that was printed, and the names of the checks that failed with any estimator."""
    out = folder / "out"
    code = main(["validate", str(folder), "-o", str(out), "-j", "1", "--no-pictures", *options])
    captured = capsys.readouterr()
    text = captured.out + captured.err
    failed = {line.split(" ", 3)[3].split(":")[0] for line in text.splitlines() if line.startswith("FAILED")}
    assert "DISAGREES" not in text
    return code, text, failed


def test_a_right_capture_passes(trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenes = trihedral[1]
    write_manifest(
        folder,
        pair_toml(scenes["same"], "same", ("regular", "regular")),
        pair_toml(scenes["mixed"], "mixed", ("regular", "fisheye")),
    )
    code, text, failed = validate(folder, capsys)
    assert (code, failed) == (0, set())
    assert "probable cause" not in text
    assert json.loads((folder / "out" / "tables.json").read_text())


def test_other_methods_alone_agree(trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenes = trihedral[1]
    mixed = pair_toml(scenes["mixed"], "mixed", ("regular", "fisheye"))
    write_manifest(folder, pair_toml(scenes["same"], "same", ("regular", "regular")), mixed)
    command = ["crosscheck", str(folder), "-p", "same", "-j", "1", "-o"]
    assert main([*command, str(folder / "words")]) == 0
    assert "pycolmap" in capsys.readouterr().out
    assert main([*command, str(folder / "json"), "--json"]) == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert pair["passed"] and pair["checks"]


def test_boards_that_lean_fail_their_angle_and_nothing_else(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_manifest(folder, pair_toml(trihedral[1]["leaning"], "leaning", ("regular", "regular")))
    code, text, failed = validate(folder, capsys)
    assert (code, failed) == (1, {"angle plane1-plane3"})
    assert "probable cause: pair 'leaning': plane1-plane3" in text


def test_a_misread_rule_fails_the_baseline_and_nothing_else(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_manifest(
        folder,
        pair_toml(trihedral[1]["same"], "same", ("regular", "regular"), 1.03),
        pair_toml(trihedral[1]["mixed"], "mixed", ("regular", "fisheye")),
    )
    code, text, failed = validate(folder, capsys, "--no-crosscheck")
    assert (code, failed) == (1, {"baseline"})
    assert "pair 'same': baseline is off by -2.9 % while other lengths agree: it was probably misread" in text


def test_wrong_squares_are_named(trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for board in BOARDS:
        path = folder / f"{board.board_id}.toml"
        path.write_text(path.read_text().replace("50.0", "51.5"))
    write_manifest(
        folder,
        pair_toml(trihedral[1]["same"], "same", ("regular", "regular")),
        pair_toml(trihedral[1]["mixed"], "mixed", ("regular", "fisheye")),
    )
    code, text, failed = validate(folder, capsys, "--no-crosscheck")
    assert (code, failed) == (1, {"baseline"})
    assert "probable cause: square size: all 2 lengths are off by +3.0 %" in text
    assert "50.0" in text


def declare_squares(folder: Path, trihedral: Trihedral, square_mm: str) -> None:
    """Write a manifest of one pair whose second board is declared with squares of another size."""
    path = folder / "plane2.toml"
    path.write_text(path.read_text().replace("50.0", square_mm))
    write_manifest(folder, pair_toml(trihedral[1]["same"], "same", ("regular", "regular")))


def test_one_board_with_wrong_squares_is_named(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    declare_squares(folder, trihedral, "51.5")
    code, text, failed = validate(folder, capsys, "--no-crosscheck")
    assert code == 1
    assert "size plane2" in failed and failed <= {"baseline", "size plane2"}
    assert "board 'plane2': its squares are -2.9 % off relative to the other boards" in text


def test_one_board_with_squares_so_wrong_that_it_fits_nowhere_is_named(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    declare_squares(folder, trihedral, "43.0")
    code, text, _ = validate(folder, capsys, "--no-crosscheck")
    assert code == 1
    printed = (
        "board 'plane2' would be consistent with the others with squares of 50.0 mm (43 is declared); measure "
        "them again"
    )
    assert f"probable cause: pair 'same': {printed}" in text


def test_reconstruct_names_the_board_that_fits_nowhere_too(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    declare_squares(folder, trihedral, "43.0")
    assert main(["reconstruct", str(folder), "-j", "1", "--no-pictures", "-o", str(folder / "clouds")]) == 0
    printed = (
        "same: board 'plane2' would be consistent with the others with squares of 50.0 mm (43 is declared); "
        "measure them again"
    )
    assert printed in capsys.readouterr().err


@pytest.mark.parametrize("what", ["images", "cameras"])
def test_swapped_images_and_cameras_are_named(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    order = ("regular", "fisheye")
    if what == "images":
        first, second, spare = (folder / name for name in ("mixed1.png", "mixed2.png", "spare.png"))
        first.rename(spare)
        second.rename(first)
        spare.rename(second)
    else:
        order = ("fisheye", "regular")
    write_manifest(folder, pair_toml(trihedral[1]["mixed"], "mixed", order))
    code, text, _ = validate(folder, capsys, "--no-crosscheck")
    assert code in (1, 2, 3)
    assert "the two images, or camera1 and camera2, are swapped" in text


def test_the_other_lens_s_calibration_is_named(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_manifest(folder, pair_toml(trihedral[1]["mixed"], "mixed", ("regular", "regular")))
    code, text, _ = validate(folder, capsys, "--no-crosscheck")
    assert code in (1, 2, 3)
    assert "pair 'mixed': image 2 fits camera 'fisheye'" in text
    assert "wrong camera in the manifest?" in text


def test_a_lens_that_is_in_no_calibration_is_named(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_manifest(folder, pair_toml(trihedral[1]["mixed"], "mixed", ("regular", "regular")), cameras=["regular"])
    code, text, _ = validate(folder, capsys, "--no-crosscheck")
    assert code in (1, 2, 3)
    assert "image 2 does not fit the calibration of 'regular'" in text


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_pair_without_a_baseline_does_not_end_the_others(
    trihedral: Trihedral, folder: Path, capsys: pytest.CaptureFixture[str], jobs: str
) -> None:
    scenes = trihedral[1]
    shutil.copy(folder / "leaning1.png", folder / "leaning2.png")
    write_manifest(
        folder,
        pair_toml(scenes["leaning"], "leaning", ("regular", "regular")),
        pair_toml(scenes["same"], "same", ("regular", "regular")),
    )
    out = folder / "results"
    code = main(["validate", str(folder), "-o", str(out), "-j", jobs, "--no-crosscheck"])
    captured = capsys.readouterr()
    assert code == 3
    assert "NOT every pair was validated" in captured.out
    assert any("leaning" in line and "baseline" in line for line in captured.err.splitlines())
    assert "leaning" in (out / "report.html").read_text()
    assert (out / "same" / "3SDIR.ply").is_file()
    assert "| same" in (out / "tables.md").read_text()
