"""Damaged inputs of former faults end well, and the harness that finds such faults would report them."""

from __future__ import annotations

import shutil
from pathlib import Path

import fuzz
import pytest
from fuzzing.kinds import KINDS

CORPUS = Path(__file__).resolve().parents[1] / "corpus"
CASES = sorted(path for path in CORPUS.rglob("*") if path.is_file())


@pytest.mark.parametrize("damaged", CASES, ids=lambda path: str(path.relative_to(CORPUS)))
def test_inputs_of_former_faults_end_well(damaged: Path, case_place: Path) -> None:
    """Nothing but a result, or one line that names the file, comes of it in any of its readers."""
    (case_place / "out").mkdir()
    case = f"case{damaged.suffix}"
    shutil.copy(damaged, case)
    for reader in KINDS[damaged.parent.name].readers:
        words = [word.replace("{case}", case).replace("{out}", "out") for word in reader]
        assert fuzz.fault_of(words, case, sound=False) is None, words


def test_cases_depend_on_seed_class_and_number_alone(seeds: Path, tmp_path: Path) -> None:
    kind = KINDS["board"]
    words = [fuzz.case_of(kind, "board", 7, 40, seeds, tmp_path / name) for name in ("a", "b", "c")]
    texts = [(tmp_path / name / "case.toml").read_bytes() for name in ("a", "b")]
    assert words[0] == words[1] and texts[0] == texts[1]
    assert texts[0] != (seeds / "board.toml").read_bytes()


def test_the_harness_reports_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception of another kind, a message without the file's name, and an exit code for bugs."""

    def raising(error: Exception) -> object:
        def reader(*_: object) -> None:
            raise error

        return reader

    from fuzzing import readers

    from rigkit.cli import main as cli
    from rigkit.core.errors import InputError

    call = ["fuzzing.readers:read_vnl", "case.toml"]
    for error, printed in (
        (ValueError("bad"), "ValueError: bad"),
        (InputError("no name; write one"), "does not name"),
        (InputError("case.toml: it is wrong"), "does not say what to do"),
    ):
        monkeypatch.setattr(readers, "read_vnl", raising(error))
        assert printed in str(fuzz.fault_of(call, "case.toml", sound=False))
    monkeypatch.setattr(readers, "read_vnl", raising(InputError("case.toml: one line is wrong; correct it")))
    assert fuzz.fault_of(call, "case.toml", sound=False) is None
    assert "though sound" in str(fuzz.fault_of(call, "case.toml", sound=True))
    monkeypatch.setattr(cli, "build_parser", raising(ValueError("bad")))
    assert "exit 70" in str(fuzz.fault_of(["export"], None, sound=False))


QUICK, QUICK_OF_LONG = 5, 2
"""Cases of a class, beyond its sound ones, and of one whose readers work for long; `scripts/fuzz.py` looks at more."""
LONG = ("avi", "mkv", "mp4", "mrcal-spline", "pose-at-work", "scene-image", "scene-rig", "study-at-work")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("label", sorted(KINDS))
def test_a_few_damaged_inputs_of_each_class(
    label: str, tmp_path: Path, seeds: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process: the harness has one for each class, which would import all that there is again."""
    # Views of scenes are simulated where features are few, which whatever is damaged there does not change.
    monkeypatch.setattr("rigkit.affine.features.ENOUGH_PLAIN", 20)
    kind = KINDS[label]
    damaged = 100 if label == "api" else QUICK_OF_LONG if label in LONG else QUICK
    for number in range(len(kind.readers) * (label != "commands") + damaged):
        place = tmp_path / str(number)
        words = fuzz.case_of(kind, label, 1, number, seeds, place)
        monkeypatch.chdir(place if place.is_dir() else tmp_path)
        assert fuzz.fault_of_case(kind, number, words) is None, words


def test_the_harness_counts_what_it_finds(tmp_path: Path, seeds: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In processes of their own: one that ends badly, here for want of memory, is a finding, and the rest goes on."""
    shutil.copytree(seeds, tmp_path / "seeds")
    reported = ["--classes", "truth-csv", "--count", "2", "--seed", "1", "--keep", str(tmp_path)]
    assert fuzz.main(reported) == 0
    assert "truth-csv: 2 cases, 0 findings" in capsys.readouterr().out
    assert fuzz.main([*reported, "--memory-gb", "0.001"]) == 1
    assert "truth-csv: 2 cases, 2 findings" in capsys.readouterr().out


def test_a_case_that_could_not_be_made_is_a_finding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The process ends before it notes anything: no good files to change are there."""
    (tmp_path / "seeds").mkdir()
    for label in ("truth-csv", "api"):
        reported = ["--classes", label, "--count", "1", "--seed", "1", "--keep", str(tmp_path)]
        lost = [] if label == "truth-csv" else ["--memory-gb", "0.00001"]
        assert fuzz.main([*reported, *lost]) == 1
        assert f"{label}: 1 cases, 1 findings" in capsys.readouterr().out
