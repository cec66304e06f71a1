"""SIMULATED twins of a real session: its poses, lens and bent board, with its images' errors redistributed.

In twins all images have the same distribution of errors. So they show whether sigmas of small sessions are too small in
general, or the real session violates the assumptions. The errors of an image are the residuals of a random real image,
randomly mirrored in both directions and in sign: smooth and large where the real ones are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView


def twin(
    found: Calibration, views: Mapping[str, Sequence[BoardView]], rng: np.random.Generator
) -> dict[str, list[BoardView]]:
    """Return views like those of a calibration, by image, one board in each."""
    (board,) = found.boards
    measured = {name: own[0] for name, own in views.items()}
    fields = [_field(view, board.column_count, len(board.points_mm)) for view in found.views]
    # What a fit leaves is smaller than what was there: its unknowns have taken their part.
    grow = np.sqrt(2.0) * found.sigma_px / found.rms_px
    width, height = found.camera.size_px
    out = {}
    for view, own in zip(found.views, fields, strict=True):
        exact, valid = found.camera.project(view.cam_from_board.apply(board.at(view.grid)))
        dealt = fields[rng.integers(len(fields))] * rng.choice([-1.0, 1.0])
        dealt = dealt[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
        # Corners that the other image did not show, or only as outliers, keep their own errors; outliers have none.
        at = view.grid[:, 1], view.grid[:, 0]
        error = np.nan_to_num(np.where(np.isfinite(dealt[at]), dealt[at], own[at]))
        pixels = np.clip(exact + grow * error, -0.5, np.array([width, height]) - 0.5)[valid]
        before = measured[view.image]
        out[view.image] = [replace(before, grid=view.grid[valid], pixels=pixels, sigma_px=before.sigma_px[valid])]
    return out


def _field(view: ViewResult, columns: int, corners: int) -> FloatArray:
    """Return what a view has left, (rows, columns, 2) px over its board; NaN where nothing is known."""
    out = np.full((corners // columns, columns, 2), np.nan)
    out[view.grid[view.kept, 1], view.grid[view.kept, 0]] = view.residuals_px[view.kept]
    return out
