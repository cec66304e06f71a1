"""Test the paper's claims about estimators and pose types on our figures and on the printed ones.

L. Hajder, "Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations". Figures are mean angles between
the normals at the corners and the normal of the plane through the points. The paper prints them for each plane and
capture without naming the estimator; for estimators it prints only baselines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from rigkit.core.claims import Comparison, Verdict, evaluate_claim
from rigkit.core.posetype import PoseType
from rigkit.core.tables import Cell, Table, cells, columns
from rigkit.validation.checks import ValidationReport
from rigkit.validation.tables import PaperTables, mean_normal_error

SCALED = ("2SDIR", "3SDIR")
UNSCALED = ("F2UDIR", "F3UDIR", "DET3UDIR")
WORST = "DET3UDIR"
CLAIMS = (
    "Scaled directions are the best: 2SDIR and 3SDIR are better than the other three",
    "DET3UDIR is the worst of the five",
    "Plane 1 is the worst where the motion is special",
    "Forward motion is the worst of the motions of a lens",
    "Standard stereo is the most accurate of the motions of a lens",
)
NOTHING_TO_COMPARE = "nothing to compare"
"""Verdict on a claim without figures."""


class Capture(NamedTuple):
    """A pair: its name, its lens ("regular" of "regular forward") and its motion."""

    name: str
    lens: str
    motion: str

    @classmethod
    def of(cls, pair_id: str, motion: str | None = None) -> Capture:
        """Return the capture with the lens, and the motion if not given, from the pair's name."""
        name = pair_id.replace("-", " ")
        head, _, tail = name.rpartition(" ")
        return cls(name, head, tail if motion is None else motion)


Errors = Mapping[Capture, Mapping[int, float]]
"""Capture -> number of the plane, from 1 -> degrees."""


def claim_table(reports: Sequence[ValidationReport], method: str, printed: PaperTables) -> Table:
    """Return the paper's claims, each with the verdict of our figures and that of the printed ones.

    Parameters
    ----------
    reports : pairs x estimators. The lens of a pair is its name up to the last word ("regular" of "regular-forward").
    method : estimator whose figures are used for planes and pose types.
    printed : the paper's tables.
    """
    by_plane = {Capture.of(r.pair_id, r.pose_type): _by_plane(r) for r in reports if r.affine_method == method}
    ours = _verdicts(_by_estimator(reports), "deg", by_plane)
    theirs = _verdicts(dict(_baseline_errors(printed)), "mm", _printed_planes(printed))
    rows = [
        cells(text, Cell(_words(own), failed=own is not None and not own.holds), _words(other))
        for text, own, other in zip(CLAIMS, ours, theirs, strict=True)
    ]
    note = (
        f"Planes and motions by mean normal errors with {method}; estimators by mean normal errors in our figures, by "
        "errors of the baseline in the printed ones."
    )
    heads = columns("the paper says | our figures | the printed figures")
    return Table("claims", "What the paper says, judged", heads, tuple(rows), note)


def estimator_order_table(reports: Sequence[ValidationReport], printed: PaperTables) -> Table:
    """Return a row for each estimator: mean normal error, mean baseline error, and that of the printed baselines."""
    methods = list(dict.fromkeys(r.affine_method for r in reports))
    theirs = dict(_baseline_errors(printed))
    rows = []
    for method in methods:
        of_method = [r for r in reports if r.affine_method == method]
        baselines = [abs(c.difference) for r in of_method for c in r.checks if c.kind == "baseline"]
        paper = [errors[method] for errors in theirs.values() if method in errors]
        rows.append(cells(method, mean_normal_error(of_method), _mean(baselines), _mean(paper)))
    heads = columns("estimator | mean normal error [deg] .4 | mean baseline error [mm] | printed baseline error [mm]")
    return Table("order", "The five estimators, over all pairs", heads, tuple(rows))


def _verdicts(by_estimator: Mapping[str, Mapping[str, float]], unit: str, errors: Errors) -> tuple[Verdict | None, ...]:
    """Return the verdicts on CLAIMS, from errors by estimator for each capture, and by plane."""
    first = (
        Comparison(planes[number], f"{capture.name} plane {number}", planes[1], "plane 1")
        for capture, planes in errors.items()
        for number in sorted(planes)
        if capture.motion != PoseType.GENERAL and number != 1 and 1 in planes
    )
    return (
        evaluate_claim(CLAIMS[0], _better(by_estimator, SCALED, UNSCALED, unit)),
        evaluate_claim(CLAIMS[1], _better(by_estimator, (*UNSCALED[:2], *SCALED), (WORST,), unit)),
        evaluate_claim(CLAIMS[2], first),
        evaluate_claim(CLAIMS[3], _between(errors, lambda one, other: other == PoseType.FORWARD)),
        evaluate_claim(CLAIMS[4], _between(errors, lambda one, other: one == PoseType.STANDARD)),
    )


def _between(errors: Errors, claimed: Callable[[str, str], bool]) -> Iterator[Comparison]:
    """Yield the pairs of captures of one lens for whose motions (smaller error, larger error) `claimed` is true."""
    mean = {capture: float(np.mean(list(planes.values()))) for capture, planes in errors.items() if planes}
    for one, other in product(mean, mean):
        if one != other and one.lens == other.lens and claimed(one.motion, other.motion):
            yield Comparison(mean[one], one.name, mean[other], other.name)


def _better(
    errors: Mapping[str, Mapping[str, float]], good: Sequence[str], bad: Sequence[str], unit: str
) -> Iterator[Comparison]:
    """Yield the comparisons of every good with every bad estimator for each capture."""
    for name, of in errors.items():
        for one, other in product(good, bad):
            if one in of and other in of:
                yield Comparison(of[one], f"{name} {one}", of[other], other, unit)


def _by_estimator(reports: Sequence[ValidationReport]) -> dict[str, dict[str, float]]:
    out: dict[str, dict[str, float]] = {}
    for report in reports:
        out.setdefault(Capture.of(report.pair_id).name, {})[report.affine_method] = mean_normal_error([report])
    return out


def _by_plane(report: ValidationReport) -> dict[int, float]:
    """Return the mean normal error by the number of the plane, from 1, in the order of the names."""
    found = sorted((board.board.board_id, board.normal_errors.mean_deg) for board in report.boards)
    return {number: error for number, (_, error) in enumerate(found, start=1)}


def _printed_planes(printed: PaperTables) -> Errors:
    out: dict[Capture, dict[int, float]] = {}
    for row, by_capture in printed.planes.items():
        kind, _, number = row.rpartition(" ")
        if kind == "mean normal error":
            for name, value in by_capture.items():
                out.setdefault(Capture.of(name), {})[int(number)] = float(value)
    return out


def _baseline_errors(printed: PaperTables) -> Iterator[tuple[str, dict[str, float]]]:
    for name, by_method in printed.baselines.items():
        known = float(by_method["measured"])
        yield name, {m: abs(float(v) - known) for m, v in by_method.items() if m != "measured"}


def _words(verdict: Verdict | None) -> str:
    return NOTHING_TO_COMPARE if verdict is None else verdict.words


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None
