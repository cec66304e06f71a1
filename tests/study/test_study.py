"""The synthetic study: statistics against another implementation's, and independence of processes and chunks."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from rigkit.core.errors import InputError
from rigkit.core.posetype import PoseType
from rigkit.report.pages.study_page import cell_table, study_tables
from rigkit.report.pictures import study_figure as study_figure_module
from rigkit.report.pictures.figures import new_figure
from rigkit.report.pictures.study_figure import study_figure
from rigkit.report.tables import tables_to_csv, tables_to_markdown
from rigkit.study.study import CHUNK_TRIALS, Claim, Study, Variant, chunk_count, run_chunk
from rigkit.study.table import StudyTable, tabulate
from rigkit.synthetic.noise import NoisyImages

METHODS = ("F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR")
MEDIAN_REL = 0.15
"""Medians of 100 trials x 144 corners scatter by 5 % between seeds; the scene of the other implementation differs in
details that it does not state (offset of the boards from the corner), worth as much again."""
SPECIAL_REL = 0.2
"""60 trials, planar motion drawn at random; exact degeneracies would be off by a factor."""

GENERAL = Study(
    name="general",
    title="General motion",
    seed=1,
    trials=100,
    pose_types=(PoseType.GENERAL,),
    methods=("F2UDIR",),
    noise="directions",
    sigmas=(0.0, 3.0),
)


def run(study: Study) -> StudyTable:
    return tabulate(study, [run_chunk(study, k) for k in range(chunk_count(study))])


def test_general_motion_sweep() -> None:
    table = run(replace(GENERAL, sigmas=(0.0, 1.0, 3.0, 10.0)))
    cells = {s: table.cell(sigma=s) for s in (0.0, 1.0, 3.0, 10.0)}
    assert cells[0.0].whisker_high_deg < 1e-4
    # Medians and quartiles measured by an independent simulation of the same set-up.
    for sigma, median, q25, q75 in ((1.0, 2.53, 1.49, 4.41), (3.0, 7.55, 4.45, 13.1), (10.0, 23.5, 14.3, 39.4)):
        found = cells[sigma]
        for have, want in ((found.median_deg, median), (found.q25_deg, q25), (found.q75_deg, q75)):
            assert abs(have / want - 1.0) < MEDIAN_REL
    assert cells[3.0].count == 100 * 144
    assert cells[3.0].missing == 0


def test_noise_in_one_image_is_less() -> None:
    found = run(replace(GENERAL, images=NoisyImages.SECOND)).cell(sigma=3.0)
    assert abs(found.median_deg / 5.17 - 1.0) < MEDIAN_REL


def test_order_of_the_estimators() -> None:
    table = run(replace(GENERAL, methods=METHODS, sigmas=(0.0, 0.5, 3.0)))
    at = {s: {m: table.cell(sigma=s, method=m).median_deg for m in METHODS} for s in (0.0, 0.5, 3.0)}
    assert at[3.0]["3SDIR"] < at[3.0]["2SDIR"] < at[3.0]["F3UDIR"] < at[3.0]["F2UDIR"]
    # The squared mean of the scales is biased: worst where noise is small, not at 3 degrees.
    assert max(at[0.5], key=lambda m: at[0.5][m]) == "DET3UDIR"
    assert max(at[3.0], key=lambda m: at[3.0][m]) == "F2UDIR"
    for method, want in (("F3UDIR", 4.96), ("DET3UDIR", 4.69), ("2SDIR", 3.04), ("3SDIR", 2.67)):
        assert abs(at[3.0][method] / want - 1.0) < MEDIAN_REL
    # Chords are one-sided: scaled estimators are off without any noise; exact lengths are not.
    assert at[0.0]["2SDIR"] > 0.5
    exact = run(replace(GENERAL, methods=METHODS, sigmas=(0.0,), support="neighbours", det_scale="area"))
    assert max(exact.cell(method=m).whisker_high_deg for m in METHODS) < 1e-3


def test_special_motion() -> None:
    special = (PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD)
    table = run(replace(GENERAL, trials=60, pose_types=special, sigmas=(3.0,)))
    reference = {"planar": (42.5, 16.9, 8.8), "standard": (30.8, 20.4, 3.3), "forward": (80.2, 10.7, 11.8)}
    for kind, medians in reference.items():
        found = [table.cell(pose_type=kind, plane=k).median_deg for k in (1, 2, 3)]
        np.testing.assert_allclose(found, medians, rtol=SPECIAL_REL)
        assert found[0] == max(found)


def test_edges_along_the_baseline_tell_nothing() -> None:
    aligned = replace(
        GENERAL, trials=10, pose_types=(PoseType.STANDARD,), methods=("F2UDIR", "F3UDIR"), in_plane_deg=0.0
    )
    table = run(replace(aligned, sigmas=(3.0,)))
    assert table.cell(method="F2UDIR", plane=2).median_deg > 40.0
    assert table.cell(method="F3UDIR", plane=2).median_deg < 12.0
    # The same, refused: nothing is estimated from such directions alone, and what is missing is counted.
    counted = run(replace(aligned, sigmas=(0.0,), min_conditioning=0.05)).cell(method="F2UDIR", plane=2)
    assert counted.count + counted.missing == 10 * 48


def test_corner_noise_with_estimated_epipolar_geometry() -> None:
    study = replace(
        GENERAL, methods=METHODS, noise="corners", sigmas=(0.1,), epipolar="estimated", parallax_deg=(15.0, 40.0)
    )
    table = run(study)
    chord = {m: table.cell(method=m).median_deg for m in METHODS}
    for method, want in (("DET3UDIR", 1.43), ("2SDIR", 0.92), ("3SDIR", 0.78)):
        assert abs(chord[method] / want - 1.0) < MEDIAN_REL
    assert max(chord, key=lambda m: chord[m]) == "DET3UDIR"
    assert max(chord.values()) < 2.0
    exact = run(replace(study, support="neighbours", det_scale="area"))
    assert exact.cell(method="3SDIR").median_deg < 0.5 * chord["3SDIR"]
    known = run(replace(study, epipolar="truth")).cell(method="F3UDIR").median_deg
    assert known <= chord["F3UDIR"] * 1.02


def test_chunks_stand_alone() -> None:
    study = replace(GENERAL, trials=2 * CHUNK_TRIALS + 7)
    assert chunk_count(study) == 3
    last = run_chunk(study, 2)
    assert last.shape == (1, 2, 1, 7, 144)
    np.testing.assert_array_equal(last, run_chunk(study, 2))
    # More trials add to the earlier ones, they do not change them.
    np.testing.assert_array_equal(run_chunk(replace(study, trials=1000), 1), run_chunk(study, 1))
    assert not np.array_equal(run_chunk(replace(study, seed=2), 1), run_chunk(study, 1))
    with pytest.raises(InputError, match="missing chunks"):
        tabulate(study, [run_chunk(study, 0)])


def test_box_statistics() -> None:
    study = replace(GENERAL, trials=1, sigmas=(1.0,))
    values = np.arange(144, dtype=np.float32)[None, None, None, None]
    values[..., -1] = 1000.0
    values[..., -2] = np.nan
    cell = tabulate(study, [values]).cell()
    assert (cell.count, cell.missing) == (143, 1)
    assert (cell.q25_deg, cell.median_deg, cell.q75_deg) == (35.5, 71.0, 106.5)
    # The whisker ends at the last value within 1.5 interquartile ranges, not at the outlier.
    assert (cell.whisker_low_deg, cell.whisker_high_deg) == (0.0, 141.0)


def test_claims_are_judged() -> None:
    claims = (
        Claim("better", {"method": "3SDIR"}, {"method": "F2UDIR"}),
        Claim("worse", {"method": "F2UDIR"}, {"method": "3SDIR"}),
        Claim("low noise", {"sigma": 1.0}, {"sigma": 3.0}),
    )
    table = run(replace(GENERAL, trials=20, methods=("F2UDIR", "3SDIR"), sigmas=(1.0, 3.0), claims=claims))
    better, worse, low = table.verdicts
    assert (better.holds_in, better.comparisons) == (2, 2)
    assert (worse.holds_in, worse.comparisons) == (0, 2)
    assert "at 3" in worse.against
    assert (low.holds_in, low.comparisons) == (2, 2)
    assert "does not hold" in tables_to_markdown(study_tables(table))
    with pytest.raises(InputError, match="no two cells"):
        run(replace(GENERAL, trials=1, claims=(Claim("?", {"method": "3SDIR"}, {"method": "F2UDIR"}),)))


def test_limits_are_judged_both_ways_and_keys_of_one_side_hold_for_both() -> None:
    claims = (
        Claim("generous", {"sigma": (1.0, 3.0)}, at_most_deg=30.0),
        Claim("strict", {"sigma": (1.0, 3.0)}, at_most_deg=4.0),
        Claim("at 3", {"method": "3SDIR", "sigma": [3.0]}, {"method": "F2UDIR"}),
    )
    table = run(replace(GENERAL, trials=20, methods=("F2UDIR", "3SDIR"), sigmas=(0.0, 1.0, 3.0), claims=claims))
    generous, strict, at_3 = table.verdicts
    assert generous.holds and generous.comparisons == 4
    assert (
        not strict.holds and "F2UDIR general all planes at 3" in strict.against and "the limit 4.00" in strict.against
    )
    assert (at_3.holds_in, at_3.comparisons) == (1, 1)
    with pytest.raises(InputError, match="either"):
        Claim("both", {}, {}, at_most_deg=1.0)
    with pytest.raises(InputError, match="either"):
        Claim("neither", {})


def test_variants_have_their_own_support_and_scale() -> None:
    """Exact corners: chords have no exact lengths, a patch has; and the chord's is the study's own cell of it."""
    variants = (Variant("patch", "3SDIR", "patch", "area"), Variant("chord", "3SDIR", "chord", "area"))
    study = replace(GENERAL, trials=2, noise="corners", sigmas=(0.0,), variants=variants)
    table = run(replace(study, methods=("patch", "chord", "3SDIR")))
    assert table.cell(method="patch").median_deg < 1e-4
    assert table.cell(method="chord").median_deg > 0.2
    assert table.cell(method="chord").median_deg == table.cell(method="3SDIR").median_deg
    with pytest.raises(InputError, match="known: chord"):
        replace(study, methods=("star",), variants=(Variant("star", "3SDIR", "star", "area"),))


def test_one_noise_and_one_estimator_need_no_legend() -> None:
    table = run(replace(GENERAL, trials=2, sigmas=(1.0,)))
    assert b"<svg" in study_figure(table, "svg")
    assert b"<svg" in study_figure(run(replace(GENERAL, trials=2, methods=("F2UDIR", "3SDIR"))), "svg")


def test_the_legend_of_many_estimators_is_within_the_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []

    def kept(*size: float, **more: Any) -> Figure:
        drawn.append(new_figure(*size, **more))
        return drawn[-1]

    monkeypatch.setattr(study_figure_module, "new_figure", kept)
    variants = tuple(Variant(f"DET3UDIR, chord, number {k}", "DET3UDIR", "chord", "area") for k in range(12))
    methods = tuple(variant.name for variant in variants)
    study_figure(
        run(replace(GENERAL, trials=2, noise="corners", sigmas=(0.1, 0.3), variants=variants, methods=methods))
    )
    box = drawn[0].legends[0].get_window_extent()
    assert box.x0 >= 0.0 and box.x1 <= drawn[0].bbox.width
    assert len(set(study_figure_module.METHOD_COLOURS)) >= len(methods)


def test_csv_has_every_cell() -> None:
    table = run(replace(GENERAL, trials=2))
    title, _, text = tables_to_csv([cell_table(table)]).partition("\n")
    assert title == "# General motion"
    rows = list(csv.DictReader(io.StringIO(text)))
    assert len(rows) == 2 * 4
    assert rows[0]["noise [deg]"] == "0"
    assert float(rows[-1]["median [deg]"]) == table.cell(sigma=3.0, plane=3).median_deg


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"methods": ("4SDIR",)}, "known: F2UDIR"),
        ({"noise": "pixels"}, "known: directions"),
        ({"epipolar": "estimated"}, "needs noise on corners"),
        ({"pose_types": (PoseType.AUTO,)}, "auto"),
        ({"sigmas": (-1.0,)}, "negative"),
        ({"trials": 0}, "one trial"),
    ],
)
def test_refusals(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(GENERAL, **change)
