"""Many data sets or sessions in one call: one table, equal for any number of processes; one failure ends no other."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
from helpers.data import REPOSITORY
from helpers.trihedral_captures import pair_toml, write_manifest

from rigkit.cli.main import main
from rigkit.io.manifests.manifest import load_dataset
from rigkit.synthetic.pairs import StereoScene
from rigkit.workflows.reconstruction.datasets import load_cameras

LAB = REPOSITORY / "datasets" / "lab-a"
QUICK = ["--no-pictures", "--no-crosscheck"]


@pytest.fixture(scope="module")
def captures(trihedral: tuple[Path, dict[str, StereoScene]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data sets of one pair each: a right one with calibrations that say how sure they are, one that contradicts what
    was measured, and one without its images."""
    root = tmp_path_factory.mktemp("captures")
    text = (LAB / "dataset.toml").read_text(encoding="utf-8").replace("../../calib", str(REPOSITORY / "calib"))
    text = text.replace('"images/', f'"{LAB}/images/').replace('name = "lab-a"', 'name = "one"')
    head, *pairs = text.split("[[pairs]]")
    (root / "one").mkdir()
    manifest = head + "[[pairs]]" + next(p for p in pairs if 'id = "fisheye-general"' in p)
    (root / "one" / "dataset.toml").write_text(manifest, encoding="utf-8")
    pair = pair_toml(trihedral[1]["same"], "same", ("regular", "regular"))
    for name, change in (("two", ("value_deg = 90.0", "value_deg = 80.0")), ("three", ("same1.png", "none.png"))):
        write_manifest(Path(shutil.copytree(trihedral[0], root / name)), pair.replace(*change), name=name)
    return root


def rows(path: Path) -> list[dict[str, str]]:
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def test_many_data_sets_are_one_table(captures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ["one", "two", "three"]
    command = ["validate", *(str(captures / name) for name in names), *QUICK]
    assert main([*command, "-j", "1", "-o", str(tmp_path / "a")]) == 2
    assert "three" in capsys.readouterr().out
    found = rows(tmp_path / "a" / "summary.csv")
    assert [row["data set"] for row in found] == names
    assert [row["verdict"] for row in found] == ["pass", "FAIL", "not validated"]
    assert found[0]["why"] == "" and "pair" in found[1]["why"] and "none.png" in found[2]["why"]
    assert (tmp_path / "a" / "one" / "tables.md").is_file()
    assert "1 of 3 data sets pass" in (tmp_path / "a" / "summary.html").read_text()
    twice = [str(captures / "one"), str(captures / "two"), str(captures / "one")]
    assert main(["validate", *twice, *QUICK, "-o", str(tmp_path / "c")]) == 2
    assert "two data sets are called 'one'" in capsys.readouterr().err
    assert main([*command[:2], *QUICK, "--cluster", "tcp://127.0.0.1:1", "-o", str(tmp_path / "d")]) == 2
    assert "several data sets" in capsys.readouterr().err
    assert main([*command, "-j", "0", "-o", str(tmp_path / "e")]) == 2
    assert "--jobs 0: at least one process" in capsys.readouterr().err


def test_by_processes_it_is_the_same_table(captures: Path, tmp_path: Path) -> None:
    command = ["validate", *(str(captures / name) for name in ("one", "two", "three")), *QUICK]
    for jobs in "12":
        assert main([*command, "-j", jobs, "-o", str(tmp_path / jobs)]) == 2
    one, two = (rows(tmp_path / jobs / "summary.csv") for jobs in "12")
    assert one == two and len(one) == 3


def test_on_a_dask_cluster_it_is_the_same_table(captures: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    pytest.importorskip("joblib")
    command = ["validate", *(str(captures / name) for name in ("one", "two")), *QUICK]
    assert main([*command, "-j", "1", "-o", str(tmp_path / "here")]) == 1
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        assert main([*command, "--cluster", cluster.scheduler_address, "-o", str(tmp_path / "there")]) == 1
    assert rows(tmp_path / "there" / "summary.csv") == rows(tmp_path / "here" / "summary.csv")


def test_a_session_that_fails_does_not_end_the_rest(
    pictures_of_one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        shutil.copytree(pictures_of_one, tmp_path / name)
        (tmp_path / name / "board.toml").write_text(
            'schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\n'
        )
        (tmp_path / name / "s.toml").write_text(
            f'schema = "rigkit.session/1"\nimages = "{"*.jpg" if name == "b" else "*.png"}"\nboard = "board.toml"\n'
            'model = "brown"\n'
        )
    sessions = [str(tmp_path / name / "s.toml") for name in ("a", "b")]
    assert main(["calibrate", *sessions]) == 2
    printed = capsys.readouterr()
    assert (tmp_path / "b" / "s-calibration.json").is_file()
    assert "1 of 2 sessions succeeded" in printed.err and "a/s.toml" in printed.err
    assert main(["calibrate", *sessions, "-o", str(tmp_path / "x.json")]) == 2
    assert "beside each" in capsys.readouterr().err


@pytest.fixture(name="pictures_of_one")
def _pictures_of_one(pictures: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in pictures.glob("left0[1-4].jpg"):
        shutil.copy(path, folder / path.name)
    return folder


def test_a_bad_calibration_of_a_data_set_is_warned_of(captures: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What it says of angles and baselines rests on it; cameras that no pair uses do not matter."""
    folder = Path(shutil.copytree(captures / "one", captures / "called-bad"))
    manifest = folder / "dataset.toml"
    text = manifest.read_text(encoding="utf-8")
    printed = {"severity": "bad", "message": "two cameras are mixed", "remedy": "calibrate each"}
    for name in ("mvca020_r61", "mvca020_fe185"):
        source = REPOSITORY / "calib" / "cameras" / name / "calibration.json"
        own = folder / f"{name}.json"
        own.write_text(json.dumps(json.loads(source.read_text()) | {"verdicts": [printed]}))
        text = text.replace(str(source), str(own))
    manifest.write_text(text, encoding="utf-8")
    load_cameras(load_dataset(manifest))
    called = "the calibration's verdict is bad: two cameras are mixed"
    warned = [record.getMessage() for record in caplog.records if called in record.getMessage()]
    assert len(warned) == 1 and "fe185" in warned[0]
