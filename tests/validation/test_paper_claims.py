"""Claims of the paper, judged on our figures and on its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.reconstructions import make_reconstruction

from rigkit.core.claims import Comparison, evaluate_claim
from rigkit.core.posetype import PoseType
from rigkit.core.truth import MeasuredLength, PairTruth
from rigkit.validation.checks import ValidationReport, validate
from rigkit.validation.paper_claims import CLAIMS, claim_table, estimator_order_table
from rigkit.workflows.validation.paper import load_paper_tables

PAPER = load_paper_tables(Path(__file__).parents[2] / "datasets" / "hajder2021")
METHODS = ("F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR")


def report(kind: str, method: str, tilt_deg: float) -> ValidationReport:
    made = make_reconstruction(normal_tilt_rad=np.deg2rad(tilt_deg), baseline_sigma_mm=0.5)
    named = replace(made, pair_id=f"regular-{kind}", pose_type=PoseType(kind), affine_method=method)
    return validate(named, PairTruth(MeasuredLength(300.0, 2.0, "rule")))


def verdicts(tilts: dict[str, float], kinds: dict[str, float]) -> dict[str, tuple[str, str]]:
    reports = [report(kind, m, tilt * factor) for kind, factor in kinds.items() for m, tilt in tilts.items()]
    table = claim_table(reports, "3SDIR", PAPER)
    return {str(row[0].value): (str(row[1].value), str(row[2].value)) for row in table.rows}


def test_claims_that_hold_and_claims_that_do_not() -> None:
    as_claimed = dict(zip(METHODS, (3.0, 2.0, 4.0, 1.0, 0.8), strict=True))
    found = verdicts(as_claimed, {"standard": 1.0, "planar": 2.0, "forward": 3.0})
    for claim in (CLAIMS[0], CLAIMS[1], CLAIMS[3], CLAIMS[4]):
        assert found[claim][0].startswith("holds (in all")
    opposite = dict(zip(METHODS, (0.8, 1.0, 0.5, 3.0, 4.0), strict=True))
    found = verdicts(opposite, {"standard": 3.0, "planar": 2.0, "forward": 1.0})
    for claim in (CLAIMS[0], CLAIMS[1], CLAIMS[3], CLAIMS[4]):
        assert found[claim][0].startswith("does not hold")
        assert "contradicted by" in found[claim][0]


def test_the_printed_figures_are_judged_alike() -> None:
    """By hand: standard is best in all six comparisons; fisheye planar 5.68 is worse than fisheye forward 5.37."""
    found = verdicts(dict.fromkeys(METHODS, 1.0), {"standard": 1.0})
    assert found[CLAIMS[4]] == ("nothing to compare", "holds (in all 6 comparisons)")
    words = found[CLAIMS[3]][1]
    assert words.startswith("holds in 5 of 6")
    assert "fisheye planar 5.68 deg, fisheye forward 5.37 deg" in words


def test_the_order_of_the_estimators() -> None:
    reports = [report("standard", m, 1.0 + n) for n, m in enumerate(METHODS)]
    table = estimator_order_table(reports, PAPER)
    assert [row[0].value for row in table.rows] == list(METHODS)
    assert table.rows[0][1].value < table.rows[4][1].value  # type: ignore[operator]
    # |292.90 - 300|, |142.81 - 150|, |307.10 - 300|, |180.28 - 200|, averaged.
    assert table.rows[0][3].value == pytest.approx((7.10 + 7.19 + 7.10 + 19.72) / 4)


def test_unknown_figures_support_no_claim() -> None:
    unknown = evaluate_claim("x", [Comparison(float("nan"), "a", 1.0, "b")])
    assert unknown is not None and not unknown.holds
    assert evaluate_claim("x", []) is None
    limit = evaluate_claim("x", [Comparison(20.0, "a", 20.0, "limit", or_equal=True)])
    assert limit is not None and limit.holds
