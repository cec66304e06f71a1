"""Measured truth from a spreadsheet: units are never guessed."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.truth import Feature
from rigkit.io.manifests.manifest import load_dataset
from rigkit.io.manifests.truth_csv import load_truth_csv

BOARDS = {name: (Board("plane1", 8, 6, 50.0, 50.0), Board("plane2", 7, 6, 28.0, 28.0)) for name in ("first", "second")}
TEXT = """pair,quantity,a,b,value [mm],sigma [mm],value [deg],sigma [deg],how
first,baseline,,,300,2,,,"steel rule, 1 m"
first,angle,plane1,plane2,,,90,0.3,set square

second,distance,plane1.centre,plane2,412.5,1,,,steel rule
"""


def load(folder: Path, text: str = TEXT) -> dict:
    (folder / "truth.csv").write_text(text, encoding="utf-8")
    return load_truth_csv(folder / "truth.csv", BOARDS)


def test_every_kind_of_row(tmp_path: Path) -> None:
    truth = load(tmp_path)
    assert list(truth) == ["first", "second"]
    first, second = truth["first"], truth["second"]
    assert (first.baseline.value_mm, first.baseline.sigma_mm, first.baseline.how) == (300.0, 2.0, "steel rule, 1 m")
    assert (first.angles[0].a, first.angles[0].value_deg, first.angles[0].sigma_deg) == ("plane1", 90.0, 0.3)
    assert second.distances[0].a == Feature("plane1", None, True)
    assert (second.distances[0].value_mm, second.baseline) == (412.5, None)


def test_as_spreadsheets_save_it(tmp_path: Path) -> None:
    plain = load(tmp_path)
    excel = "\ufeff" + TEXT.replace('"steel rule, 1 m"', "steel rule; 1 m").replace(";", "").replace(",", ";")
    commented = "# rule, tape, set square, level\r\n" + excel.removeprefix("\ufeff").replace("\n", "\r\n")
    tabbed = TEXT.replace('"steel rule, 1 m"', "steel rule").replace(",", "\t")
    for text in (commented, tabbed):
        assert load(tmp_path, text)["second"] == plain["second"]
    found = load(tmp_path, excel.replace("\n", "\r\n"))
    assert found["first"].baseline.value_mm == plain["first"].baseline.value_mm
    assert found["second"] == plain["second"]


@pytest.mark.parametrize(("unit", "factor"), [("cm", 10.0), ("m", 1000.0)])
def test_other_units_are_converted(tmp_path: Path, unit: str, factor: float) -> None:
    found = load(tmp_path, TEXT.replace("[mm]", f"[{unit}]"))
    assert found["first"].baseline.value_mm == 300.0 * factor
    assert found["first"].baseline.sigma_mm == 2.0 * factor


def test_two_means_may_measure_one_thing_and_a_point_may_lie_near_a_plane(tmp_path: Path) -> None:
    by_eye = "second,angle,plane1,plane2,,,90,2,protractor\nsecond,angle,plane1,plane2,,,90,0.3,set square\n"
    flush = "second,distance,plane1.centre,plane2,0.2,0.5,,,feeler gauge\n"
    second = load(tmp_path, TEXT + by_eye + flush)["second"]
    assert (len(second.angles), second.distances[1].sigma_mm) == (2, 0.5)


WRONG = [
    ("value [mm]", "value", "'value' has no unit"),
    ("value [mm]", "value [inch]", "unknown unit"),
    ("sigma [mm]", "sigma [cm]", "mix units"),
    ("value [deg]", "value [cm]", "mix units"),
    ("sigma [deg]", "sigma [mm]", "mix units"),
    ("value [mm],sigma [mm],", "", "line 2: 9 cells, but the head has 7"),
    ("how\n", "colour\n", "'colour' is unknown"),
    (",300,2,", ",300 mm,2,", "line 2: .*'300 mm' is no number"),
    (",300,2,", ',"300,5",2,', "decimal point"),
    (",300,2,", ",300,,", "line 2: .*'sigma .mm.' is empty"),
    (",300,2,", ",300,0,", "must be positive"),
    (",300,2,", ",nan,2,", "nan"),
    (",300,2,", ",2,300,", "line 2: .*were both exchanged"),
    (",90,0.3,", ",0.3,90,", "line 3: .*were both exchanged"),
    (
        "set square\n",
        "set square\nfirst,angle,plane2,plane1,,,90,1,set square\n",
        "'first': angle plane2-plane1 is stated twice",
    ),
    (",,90,0.3,", ",90,90,0.3,", "leave it empty"),
    ("set square", "", "line 3: 'how' is empty"),
    ("first,angle", "third,angle", "pair 'third' is not in the manifest; known: first, second"),
    ("angle,plane1,plane2", "angle,plane1,plane9", "'plane9' is not in this pair"),
    ("distance,", "height,", "quantity 'height' is unknown"),
    ("plane1.centre", '"plane1[0,0]"', "line 5: .*looks the same turned"),
    ("first,angle,plane1,plane2,,,90,0.3,set square", "first,baseline,,,300,2,,,rule", "stated twice"),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG)
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in TEXT
    with pytest.raises(InputError, match=words) as caught:
        load(tmp_path, TEXT.replace(old, new, 1))
    assert "truth.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_column_of_units_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"needs a column 'value \[deg\]'"):
        load(tmp_path, "pair,quantity,a,b,value [mm],sigma [mm],how\nfirst,angle,plane1,plane2,,,square\n")


def test_nothing_measured_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no measurements"):
        load(tmp_path, TEXT.splitlines()[0] + "\n")
    with pytest.raises(InputError, match="does not exist"):
        load_truth_csv(tmp_path / "none.csv", BOARDS)


MANIFEST = """schema = "rigkit.dataset/1"
name = "small"
truth_table = "truth.csv"
boards = [ { id = "plane1", columns = 8, rows = 6, square_mm = 50.0 },
           { id = "plane2", columns = 7, rows = 6, square_mm = 28.0 } ]
cameras = [ { id = "cam", calibration = "calibration.json" } ]
[[pairs]]
id = "first"
camera1 = "cam"
camera2 = "cam"
image1 = "a.png"
image2 = "b.png"
pose_type = "general"
boards = ["plane1", "plane2"]
"""


def test_the_manifest_takes_it(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").touch()
    (tmp_path / "dataset.toml").write_text(MANIFEST)
    (tmp_path / "truth.csv").write_text("\n".join(TEXT.splitlines()[:3]))
    assert load_dataset(tmp_path).pair("first").truth.count == 2
    both = MANIFEST + '[pairs.truth]\nbaseline = { value_mm = 300.0, sigma_mm = 2.0, how = "rule" }\n'
    (tmp_path / "dataset.toml").write_text(both)
    with pytest.raises(InputError, match="both here and in"):
        load_dataset(tmp_path)
