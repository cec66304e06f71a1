"""lab-a from its images, with cameras calibrated from its images, against the exact truth of the captures."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from helpers.data import REPOSITORY, shared_data
from helpers.once import once_a_run

PATH_TRACED = ("regular-general", "regular-planar")
"""Noisier images, and noise that neighbouring pixels share."""
CORNER_RMS_PX = {True: 0.05, False: 0.015}
"""2-D, of path-traced images and of the others: a fifth above what their noise allows."""
ORTHOGONALITY_DEG = {"general": 0.06, "planar": 0.12, "standard": 0.03, "forward": 0.4}
MEAN_NORMAL_DEG = {"general": 0.1, "planar": 0.2, "standard": 0.05, "forward": 0.6}
"""Forward motion: the effective baseline is the distance from the focus of expansion; the plane ahead is lost first."""
BASELINE_PERCENT = 0.1
ROTATION_DEG = 0.015

PAPER_OVER_OURS = {"orthogonality_deg": 40.0, "mean_normal_deg": 30.0, "baseline_mm": 200.0}
"""What the averages over the cells of the paper's tables should gain by at least; these captures are rendered."""

CORNERS = 144

PAIRS = [f"{lens}-{pose}" for lens in ("regular", "fisheye") for pose in ORTHOGONALITY_DEG]
QUICK_PAIRS = ("regular-general", "regular-forward", "fisheye-planar", "fisheye-standard")
"""Each lens, and each motion once: measured by the quick run, in half of the time of all."""


def load_accuracy() -> Any:
    path = REPOSITORY / "scripts" / "accuracy.py"
    spec = importlib.util.spec_from_file_location("accuracy", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


Measured = Callable[[str], dict[str, Any]]


@pytest.fixture(scope="module", params=["raw", pytest.param("rectified", marks=pytest.mark.thorough)])
def measured(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """Return the measurement of a pair by its name."""
    folder: Path = shared_data("lab-a")

    def of(pair_id: str) -> dict[str, Any]:
        group = [pair for pair in PAIRS if (pair in QUICK_PAIRS) == (pair_id in QUICK_PAIRS)]

        def measure() -> dict[str, Any]:
            found = load_accuracy().measure(folder, pairs=group, chain=request.param, jobs=1)
            return {pair["pair"]: pair for pair in found["pairs"]}

        return dict(once_a_run(tmp_path_factory, f"lab-a-{request.param}-with-{group[0]}", measure)[pair_id])

    return of


@pytest.mark.real
@pytest.mark.parametrize(
    "pair_id", [p if p in QUICK_PAIRS else pytest.param(p, marks=pytest.mark.thorough) for p in PAIRS]
)
def test_pair_against_truth(measured: Measured, pair_id: str) -> None:
    pair = measured(pair_id)
    pose = pair_id.split("-")[1]
    assert pair["corners"] == CORNERS
    assert pair["matched"]
    assert pair["corner_rms_px"] <= CORNER_RMS_PX[pair_id in PATH_TRACED]
    assert set(pair["methods"]) == {"F2UDIR", "F3UDIR", "DET3UDIR", "2SDIR", "3SDIR"}
    best = pair["methods"][load_accuracy().best_method(pair["methods"])]
    assert max(best["orthogonality_deg"]) <= ORTHOGONALITY_DEG[pose]
    assert max(best["mean_normal_deg"]) <= MEAN_NORMAL_DEG[pose]
    assert abs(best["baseline_percent"]) <= BASELINE_PERCENT
    assert best["rotation_deg"] <= ROTATION_DEG


@pytest.mark.real
@pytest.mark.parametrize("pairs", [QUICK_PAIRS, pytest.param(PAIRS, marks=pytest.mark.thorough)], ids=["some", "all"])
def test_averages_against_those_of_the_paper(measured: Measured, pairs: Sequence[str]) -> None:
    found = load_accuracy().averages([measured(pair) for pair in pairs])
    assert found.keys() == PAPER_OVER_OURS.keys()
    for what, (ours, paper) in found.items():
        assert paper / ours >= PAPER_OVER_OURS[what], (what, ours, paper)
