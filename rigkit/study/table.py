"""Tabulate a synthetic study: box-plot statistics of each cell, and verdicts on the claims."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import without_nan
from rigkit.core.claims import Comparison, Verdict, evaluate_claim
from rigkit.core.errors import InputError
from rigkit.study.study import STUDY_PLANES, Claim, Study

ALL_PLANES = 0
"""`StudyCell.plane` of the cell over all planes."""
WHISKER_IQR = 1.5
"""Whiskers end at the last value within this many interquartile ranges of the box, as in the paper's figures."""
EXACT_DEG = 1e-5
"""Errors below are rounding (they are stored in single precision); two such cells are not compared."""
CELL_STATISTICS = ("median_deg", "q25_deg", "q75_deg", "whisker_low_deg", "whisker_high_deg", "mean_deg")
CELL_KEYS = ("pose_type", "sigma", "method", "plane")


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyCell:
    """Angular errors of normals, degrees, over trials and corners.

    Attributes
    ----------
    pose_type, sigma, method, plane : keys of the cell; plane 1, 2, 3 or 0 for all.
    count, missing : corners with and without an estimate.
    """

    pose_type: str
    sigma: float
    method: str
    plane: int
    count: int
    missing: int
    median_deg: float
    q25_deg: float
    q75_deg: float
    whisker_low_deg: float
    whisker_high_deg: float
    mean_deg: float


@dataclass(frozen=True, slots=True)
class StudyTable:
    """Every cell of a study and the verdicts on its claims."""

    study: Study
    cells: tuple[StudyCell, ...]
    verdicts: tuple[Verdict, ...]

    def cell(self, **which: Any) -> StudyCell:
        """Return the cell with these keys (default plane: all); raises InputError if there is not exactly one."""
        found = _select(self.cells, {"plane": ALL_PLANES, **which})
        if len(found) != 1:
            raise InputError(
                f"study '{self.study.name}': {len(found)} cells match {which}; name one of each of {CELL_KEYS}"
            )
        return found[0]

    def to_dict(self) -> dict[str, Any]:
        verdicts = [asdict(v) | {"verdict": v.words} for v in self.verdicts]
        study = self.study.to_dict() | {"unit": self.study.unit}
        cells = without_nan([asdict(c) for c in self.cells])
        return {"schema": "rigkit.study_result/1", "study": study, "cells": cells, "claims": verdicts}


def tabulate(study: Study, chunks: Sequence[NDArray[np.float32]]) -> StudyTable:
    """Return the table of a study from all its chunks, in the order of their index in `run_chunk`."""
    errors = np.concatenate(chunks, axis=3)
    if errors.shape[3] != study.trials:
        raise InputError(f"study '{study.name}': {errors.shape[3]} of {study.trials} trials; run the missing chunks")
    cells = tuple(_cells(study, errors))
    return StudyTable(study, cells, tuple(_evaluated(claim, cells) for claim in study.claims))


def _cells(study: Study, errors: NDArray[np.float32]) -> Iterator[StudyCell]:
    per_board = study.board.corner_count
    for p, pose_type in enumerate(study.pose_types):
        for s, sigma in enumerate(study.sigmas):
            for m, method in enumerate(study.methods):
                for plane in range(STUDY_PLANES + 1):
                    block = errors[p, s, m]
                    if plane != ALL_PLANES:
                        block = block[:, (plane - 1) * per_board : plane * per_board]
                    yield StudyCell(
                        pose_type=str(pose_type), sigma=sigma, method=method, plane=plane, **_statistics(block.ravel())
                    )


def _statistics(values: NDArray[np.float32]) -> dict[str, Any]:
    """Return the statistics of `StudyCell`, NaN without any finite angle."""
    good = np.sort(values[np.isfinite(values)].astype(np.float64))
    counts = {"count": good.size, "missing": values.size - good.size}
    if not good.size:
        return counts | dict.fromkeys(CELL_STATISTICS, float("nan"))
    q25, median, q75 = np.percentile(good, [25.0, 50.0, 75.0])
    reach = WHISKER_IQR * (q75 - q25)
    low = good[np.searchsorted(good, q25 - reach, side="left")]
    high = good[np.searchsorted(good, q75 + reach, side="right") - 1]
    return counts | dict(zip(CELL_STATISTICS, map(float, (median, q25, q75, low, high, good.mean())), strict=True))


def _select(cells: Sequence[StudyCell], which: Mapping[str, Any]) -> list[StudyCell]:
    """Return the cells with these keys; a list or tuple matches any of its values."""

    def fits(cell: StudyCell) -> bool:
        return all(
            getattr(cell, key) in value if isinstance(value, tuple | list) else getattr(cell, key) == value
            for key, value in which.items()
        )

    return [cell for cell in cells if fits(cell)]


def _evaluated(claim: Claim, cells: Sequence[StudyCell]) -> Verdict:
    verdict = evaluate_claim(claim.text, _comparisons(claim, cells))
    if verdict is None:
        raise InputError(f"claim '{claim.text}': no two cells of this study can be compared; check its keys and values")
    return verdict


def _comparisons(claim: Claim, cells: Sequence[StudyCell]) -> Iterator[Comparison]:
    """Yield the comparisons of a claim: cells that agree in all keys that not both sides name, or with the limit."""
    larger = claim.larger or {}
    free = [key for key in CELL_KEYS if key not in claim.smaller or key not in larger]
    default = {"plane": ALL_PLANES} if "plane" not in {**claim.smaller, **larger} else {}
    for small in _select(cells, claim.smaller | default):
        if claim.at_most_deg is not None:
            yield Comparison(small.median_deg, _name(small), claim.at_most_deg, "the limit", or_equal=True)
            continue
        for large in _select(cells, larger | default):
            if any(getattr(small, key) != getattr(large, key) for key in free):
                continue
            if max(small.median_deg, large.median_deg) < EXACT_DEG:
                continue
            yield Comparison(small.median_deg, _name(small), large.median_deg, _name(large))


def _name(cell: StudyCell) -> str:
    plane = f"plane {cell.plane}" if cell.plane else "all planes"
    return f"{cell.method} {cell.pose_type} {plane} at {cell.sigma:g}"
