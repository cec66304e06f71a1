"""`validate --paper` on the laboratory's rendered images: five estimators that differ, tables and claims beside the
printed ones; and normals' directions and scale as options of what rigkit does itself."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from rigkit.cli.main import main
from rigkit.core.errors import ExitCode
from rigkit.workflows.options.clouds import PaperOptions, ValidateOptions
from rigkit.workflows.validation.paper import validate_as_paper
from rigkit.workflows.validation.validate import validate_dataset

LAB = Path(__file__).parents[3] / "datasets" / "lab-a"
PAIRS = ("regular-standard", "regular-forward")
METHODS = ("F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR")


@pytest.fixture(scope="module")
def repeated(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, Path]:
    out = tmp_path_factory.mktemp("paper") / "out"
    return validate_as_paper(LAB, PaperOptions(pairs=PAIRS, jobs=1, output=out)), out


def test_five_estimators_that_differ_in_every_row(repeated) -> None:
    done, _ = repeated
    for pair in PAIRS:
        reports = {r.affine_method: r for r in done.reports if r.pair_id == pair}
        assert tuple(reports) == METHODS
        for one, other in combinations(reports.values(), 2):
            assert abs(one.baseline_mm - other.baseline_mm) > 1e-4
            for mine, theirs in zip(one.boards, other.boards, strict=True):
                assert abs(mine.normal_errors.mean_deg - theirs.normal_errors.mean_deg) > 1e-4


def test_tables_have_the_printed_numbers_and_the_claims(repeated) -> None:
    done, out = repeated
    tables = {table.key: table for table in done.tables}
    assert set(tables) == {"planes", "baselines", "averages", "order", "claims", "estimators"}
    columns = [c.label for c in tables["planes"].columns]
    rows = {str(row[0].value): row for row in tables["planes"].rows}
    cell = rows["mean normal error plane2"][columns.index("regular-forward")]
    assert cell.paper == "8.3326"
    assert (out / "tables.md").read_text() == done.files["tables.md"]
    page = (out / "report.html").read_text()
    assert "statements of the paper that this data set can test are confirmed" in page
    assert "DET3UDIR is the worst of the five" in page and "The images are rendered." in page
    verdicts = {str(row[0].value): str(row[1].value) for row in tables["claims"].rows}
    # Equal weights and the squared mean scale: on exact renders the scale's bias is the largest error there is.
    assert verdicts["DET3UDIR is the worst of the five"].startswith("holds (in all 8")
    # With corners right to a hundredth of a pixel chords' lengths are worse than their angles: not as the paper says.
    assert "contradicted by" in verdicts[next(text for text in verdicts if text.startswith("Scaled"))]


def test_own_solvers_find_the_baseline_whatever_the_affinities(repeated) -> None:
    """Standard stereo is two numbers; the planar solver lets 480 affinity rows bend it by millimetres."""
    done, _ = repeated
    own = validate_as_paper(LAB, PaperOptions(pairs=PAIRS[:1], jobs=1, own_solvers=True))
    for report in own.reports:
        planar = next(r for r in done.reports if (r.pair_id, r.affine_method) == (PAIRS[0], report.affine_method))
        assert abs(report.baseline_mm - 300.0) < 3.0 < abs(planar.baseline_mm - 300.0)


def test_directions_and_scale_are_options(tmp_path: Path) -> None:
    def errors(**options: Any) -> dict[str, float]:
        chosen = ValidateOptions(pairs=("regular-general",), jobs=1, pictures=False, crosscheck=False, **options)
        return {r.affine_method: r.boards[0].normal_errors.mean_deg for r in validate_dataset(LAB, chosen).reports}

    patch, chord, squared = errors(), errors(support="chord"), errors(det_scale="sqmean")
    assert all(chord[m] > 2.0 * patch[m] for m in METHODS)
    assert squared["DET3UDIR"] > 10.0 * patch["DET3UDIR"]
    assert squared["3SDIR"] == patch["3SDIR"]


def test_contradictory_options_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for options, words in (
        (["--own-solvers"], "add that"),
        (["--paper", "--directions", "line"], "fixes directions"),
    ):
        assert main(["validate", str(LAB), "-o", str(tmp_path / "out"), *options]) == ExitCode.BAD_INPUT
        assert words in capsys.readouterr().err


def test_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["validate", str(LAB), "--paper", "-p", "regular-standard", "-j", "1", "-o", str(tmp_path / "out")]
    assert main([*arguments, "--json"]) == ExitCode.WELL
    printed = capsys.readouterr()
    assert [r["affine_method"] for r in json.loads(printed.out)["reports"]] == list(METHODS)
    # Exit code 0 is no word on the baseline.
    assert "neither what was measured nor what is declared" in printed.err
