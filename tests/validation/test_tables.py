"""The tables have the figures of the reports and of the paper, and come back from every format."""

from __future__ import annotations

import csv
import io
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.reconstructions import make_reconstruction

from rigkit.core.errors import InputError
from rigkit.core.tables import Cell, Column, Table, cells, columns
from rigkit.core.truth import MeasuredAngle, MeasuredLength, PairTruth
from rigkit.report.render import render, table_context
from rigkit.report.tables import (
    measured_words,
    tables_to_csv,
    tables_to_json,
    tables_to_latex,
    tables_to_markdown,
    tables_to_text,
    without_empty_columns,
)
from rigkit.validation.checks import ValidationReport, validate
from rigkit.validation.tables import PaperTables, best_method, best_report, build_tables, check_table, plane_table
from rigkit.workflows.validation.paper import load_paper_tables

REPO = Path(__file__).parents[2]
PAPER = REPO / "datasets" / "hajder2021"
METHODS = ("F2UDIR", "3SDIR")
PAIRS = ("regular-general", "regular-standard", "my_own-pair")
TILT_DEG = {"F2UDIR": 2.0, "3SDIR": 0.5}
BASELINE_MM = {"F2UDIR": 310.0, "3SDIR": 301.0}


def report(pair_id: str, method: str, keep: tuple[int, ...] = (0, 1, 2)) -> ValidationReport:
    angles = tuple(
        MeasuredAngle(a, b, 90.0, 0.3, "set square")
        for a, b in (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))
    )
    length = MeasuredLength(300.0, 2.0, "steel rule") if "standard" in pair_id else None
    made = make_reconstruction(
        angles_deg=(90.5, 90.0, 90.0), keep=keep, normal_tilt_rad=np.deg2rad(TILT_DEG[method]), baseline_sigma_mm=0.5
    )
    return validate(
        replace(made, pair_id=pair_id, affine_method=method, baseline_mm=BASELINE_MM[method]), PairTruth(length, angles)
    )


@pytest.fixture(scope="module")
def reports() -> list[ValidationReport]:
    return [report(pair_id, method) for pair_id in PAIRS for method in METHODS]


@pytest.fixture(scope="module")
def tables(reports: list[ValidationReport]) -> tuple[Table, ...]:
    return build_tables(reports, load_paper_tables(PAPER))


def by_key(tables: tuple[Table, ...], key: str) -> Table:
    return next(table for table in tables if table.key == key)


def cell(table: Table, row: str, column: str) -> Cell:
    labels = [c.label for c in table.columns]
    return next(r for r in table.rows if r[0].value == row)[labels.index(column)]


def test_plane_table_is_ours_beside_the_papers(tables: tuple[Table, ...]) -> None:
    planes = by_key(tables, "planes")
    assert [c.label for c in planes.columns[1:]] == list(PAIRS)
    assert len(planes.rows) == 9
    tilted = cell(planes, "orthogonality error plane1, plane2", "regular-general")
    assert tilted.value == pytest.approx(0.5)
    assert tilted.paper == "3.6010"
    assert cell(planes, "mean normal error plane3", "regular-standard").value == pytest.approx(0.5)
    assert cell(planes, "mean normal error plane3", "regular-standard").paper == "0.2025"
    assert cell(planes, "median normal error plane2", "my_own-pair").paper is None


def test_the_estimator_with_the_best_normals_is_shown(reports: list[ValidationReport]) -> None:
    assert best_method(reports) == "3SDIR"
    assert best_method([r for r in reports if r.affine_method == "F2UDIR"]) == "F2UDIR"


def test_rounding_does_not_choose_between_estimators_that_find_the_same_normals(
    reports: list[ValidationReport],
) -> None:
    def with_error(report: ValidationReport, method: str, add: float) -> ValidationReport:
        boards = tuple(replace(b, normal_errors=replace(b.normal_errors, mean_deg=0.5 + add)) for b in report.boards)
        return replace(report, affine_method=method, boards=boards)

    for rounding in (-1e-14, 1e-14):
        tied = [
            with_error(r, method, add)
            for r in reports
            if r.affine_method == "3SDIR"
            for method, add in (("F3UDIR", 1e-4), ("DET3UDIR", 0.0), ("3SDIR", rounding))
        ]
        assert best_method(tied) == "3SDIR"
        assert best_report(tied[:3]).affine_method == "3SDIR"


def test_baselines_mark_the_nearest_and_the_failed(tables: tuple[Table, ...]) -> None:
    baselines = by_key(tables, "baselines")
    assert [row[0].value for row in baselines.rows] == ["regular-standard"]
    worse, better = (cell(baselines, "regular-standard", m) for m in METHODS)
    assert (worse.value, worse.paper, worse.best, worse.failed) == (310.0, "292.90", False, True)
    assert (better.value, better.paper, better.best, better.failed) == (301.0, "290.70", True, False)
    assert cell(baselines, "regular-standard", "measured").value == 300.0


def test_nothing_is_marked_where_all_estimators_agree(reports: list[ValidationReport]) -> None:
    same = [replace(r, baseline_mm=301.0) for r in reports]
    baselines = by_key(build_tables(same), "baselines")
    assert not any(c.best for row in baselines.rows for c in row)


def test_what_brackets_mean_is_said_wherever_there_are_any(tables: tuple[Table, ...]) -> None:
    for key, words in (("planes", True), ("checks", False)):
        table = by_key(tables, key)
        page = render("table.html", table=table_context(table))
        printed = [tables_to_markdown([table]), tables_to_text([table]), tables_to_latex([table]), page]
        assert [("In brackets" in text) for text in printed] == [words] * 4


def test_averages_are_over_the_cells_that_the_paper_has(tables: tuple[Table, ...]) -> None:
    averages = by_key(tables, "averages")
    row = next(r for r in averages.rows if str(r[0].value).startswith("orthogonality"))
    # Two of the three pairs are the paper's, three angles each; ours is half a degree in one of three.
    assert row[2].value == 6.0
    assert row[3].value == pytest.approx(0.5 / 3.0)
    assert row[4].value == pytest.approx(np.mean([3.6010, 0.2599, 4.1743, 0.5946, 1.1304, 0.6968]))
    assert [cell.value for cell in row[-2:]] == ["not stated", "maximum likelihood"]
    baseline = averages.rows[-1]
    assert (baseline[3].value, baseline[4].value) == pytest.approx((5.5, (7.10 + 9.30) / 2.0))


def test_without_the_paper_nothing_of_it_is_there(reports: list[ValidationReport]) -> None:
    tables = build_tables(reports)
    assert [t.key for t in tables] == ["planes", "baselines", "checks", "estimators"]
    assert "paper" not in tables_to_markdown(tables)


def test_checks_hold_every_check_and_what_could_not_be_checked() -> None:
    lost = report("regular-standard", "3SDIR", keep=(0, 1))
    checks = by_key(build_tables([lost]), "checks")
    assert len(checks.rows) == len(lost.checks) + 2
    verdict = [c.label for c in checks.columns].index("verdict")
    assert [row[verdict].value for row in checks.rows] == ["pass", "pass", "NOT CHECKED", "NOT CHECKED"]
    assert "k = 2" in checks.note


def test_no_rows_no_table() -> None:
    with pytest.raises(InputError, match="no report"):
        build_tables([])
    with pytest.raises(InputError, match="no rows"):
        Table("x", "x", (Column("a"),), ())


def test_csv_has_full_precision_and_columns_for_paper_and_sigma(tables: tuple[Table, ...]) -> None:
    text = tables_to_csv(tables)
    blocks = [block.splitlines() for block in text.split("\n\n")]
    assert [block[0] for block in blocks] == [f"# {t.title}" for t in tables]
    rows = list(csv.DictReader(io.StringIO("\n".join(blocks[1][1:]))))
    assert rows[0]["3SDIR [mm]"] == "301"
    assert rows[0]["3SDIR sigma [mm]"] == "0.5"
    assert rows[0]["3SDIR paper [mm]"] == "290.70"
    planes = list(csv.DictReader(io.StringIO("\n".join(blocks[0][1:]))))
    assert float(planes[0]["regular-general"]) == cell(tables[0], planes[0]["deg"], "regular-general").value


def test_json_is_the_same_numbers(tables: tuple[Table, ...]) -> None:
    data = json.loads(tables_to_json(tables))
    assert [t["key"] for t in data["tables"]] == [t.key for t in tables]
    baseline = data["tables"][1]["rows"][0]
    assert baseline["3SDIR"] == {"value": 301.0, "sigma": 0.5, "paper": 290.7, "best": True}
    assert data["tables"][1]["units"]["3SDIR"] == "mm"


def test_markdown_rows_have_the_cells_of_their_head(tables: tuple[Table, ...]) -> None:
    text = tables_to_markdown(tables)
    for block in text.split("## ")[1:]:
        bars = {line.replace(r"\|", "").count("|") for line in block.splitlines() if line.startswith("|")}
        assert len(bars) == 1
    assert "**301.00 ± 0.50 (290.70)**" in text


def test_latex_is_latex(tables: tuple[Table, ...], tmp_path: Path) -> None:
    text = tables_to_latex(tables)
    assert text.count(r"\begin{table}") == text.count(r"\end{table}") == len(tables)
    assert r"my\_own-pair" in text
    assert "±" not in text
    for table, block in zip(tables, text.split(r"\toprule")[1:], strict=True):
        cells = {line.replace(r"\&", "").count("&") + 1 for line in block.splitlines() if line.endswith(r"\\")}
        assert cells == {len(table.columns)}
    if shutil.which("pdflatex"):
        preamble = "\\documentclass{article}\\usepackage{booktabs,graphicx}\\begin{document}\n"
        (tmp_path / "t.tex").write_text(preamble + text + "\\end{document}\n")
        subprocess.run(["pdflatex", "-halt-on-error", "t.tex"], cwd=tmp_path, check=True, capture_output=True)


def test_the_papers_tables_are_as_printed() -> None:
    paper = load_paper_tables(PAPER)
    assert len(paper.planes) == 9
    assert all(len(row) == 8 for row in paper.planes.values())
    assert paper.plane("mean normal error 3", "fisheye-forward") == "1.334"
    assert paper.baseline("fisheye-forward", "DET3UDIR") == "179.5"
    assert paper.baseline("fisheye-planar", "DET3UDIR") is None
    # Checksums of the design's table: a mistyped cell changes them.
    assert sum(float(v) for row in paper.planes.values() for v in row.values()) == pytest.approx(204.6419, abs=1e-9)
    assert sum(float(v) for row in paper.baselines.values() for v in row.values()) == pytest.approx(5579.56, abs=1e-9)


def test_a_spoiled_paper_table_is_refused(tmp_path: Path) -> None:
    for name in ("planes.csv", "baselines.csv"):
        shutil.copy(PAPER / name, tmp_path / name)
    for text, words in (
        ("a,b\nx,1,2\n", "line 2: 3 cells"),
        ("a,b\nx,one\n", "'one' is not a number"),
        ("a,b\n", "no rows"),
    ):
        (tmp_path / "planes.csv").write_text(text)
        with pytest.raises(InputError, match=words):
            load_paper_tables(tmp_path)
    (tmp_path / "planes.csv").write_bytes(b"\xff\xfea")
    for folder, words in (("none", "does not exist"), (".", "not UTF-8")):
        with pytest.raises(InputError, match=words):
            load_paper_tables(tmp_path / folder)
    assert isinstance(load_paper_tables(PAPER), PaperTables)


def test_a_small_sigma_is_not_shown_as_nothing() -> None:
    assert measured_words(120.0031, 0.0042, 2) == "120.003 ± 0.004"
    assert measured_words(301.0, 0.5, 2) == "301.00 ± 0.50"
    assert measured_words(301.0, 0.0, 2) == "301.00 ± 0.00"
    assert measured_words(301.0, None, 2) == measured_words(301.0, float("nan"), 2) == "301.00"


def test_what_estimators_share_is_one_row_and_another_angle_than_a_right_one_has_its_own_word(
    reports: list[ValidationReport],
) -> None:
    one = reports[0]
    twin = replace(one, affine_method="TWIN")
    rows = check_table([one, twin]).rows
    assert len(rows) == len(one.checks) + len(one.unchecked)
    assert {row[1].value for row in rows} == {f"{one.affine_method}, TWIN"}
    other = replace(one, angles=tuple(replace(a, measured_deg=88.0) for a in one.angles))
    names = [str(row[0].value) for row in plane_table([other], other.affine_method, PaperTables()).rows]
    assert any(name.startswith("angle error plane1") for name in names)
    assert not any(name.startswith("orthogonality") for name in names)


def test_columns_that_are_empty_in_every_row_are_for_programs_only() -> None:
    heads = columns("pair | measured [mm] | how | shift [mm] | turn [deg] | remark")
    rows = (cells("a", None, "", 0.0, float("nan"), ""), cells("b", None, "", 0.0, None, "late"))
    table = Table("t", "T", heads, rows)
    assert [column.label for column in without_empty_columns(table).columns] == ["pair", "shift", "remark"]
    for text in (tables_to_markdown([table]), tables_to_latex([table]), tables_to_text([table])):
        assert "shift" in text and "late" in text and "measured" not in text and "turn" not in text
    assert [label for label, _ in table_context(table)["head"]] == ["pair", "shift, mm", "remark"]
    assert "measured [mm]" in tables_to_csv([table]) and '"measured": null' in tables_to_json([table])
