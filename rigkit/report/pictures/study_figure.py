"""Box plots of a synthetic study, in the layout of the paper's figures."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from rigkit.report.pictures.figures import new_figure
from rigkit.study.study import STUDY_PLANES
from rigkit.study.table import ALL_PLANES, StudyCell, StudyTable

METHOD_COLOURS: tuple[str, ...] = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")
METHOD_COLOURS += ("#332288", "#44aa99", "#882255", "#999933", "#cc6677", "#111111")
UNDATED: dict[str, dict[str, None]] = {"png": {"Software": None}, "pdf": {"CreationDate": None}}
"""What is left out of a file by format, so that the same figure gives the same file."""
SWATCH_INCHES, LETTER_INCHES = 0.6, 0.085
"""Widths in the legend: of a swatch with the gaps around it, and of a letter of a method's name."""


def study_figure(table: StudyTable, file_format: str = "png") -> bytes:
    """Return the figure as a file, with one row of axes for each pose type and one column for each plane.

    Boxes are grouped by noise level, one for each method; whiskers are as in `StudyCell`. A study of one pose type
    shows all planes together.
    """
    study = table.study
    planes = [ALL_PLANES] if len(study.pose_types) == 1 else [*range(1, STUDY_PLANES + 1)]
    rows, columns = len(study.pose_types), len(planes)
    width = max(4.2, 0.28 * len(study.sigmas) * len(study.methods) + 1.5)
    figure = new_figure(min(max(width * columns, 6.2), 13.0), 3.0 * rows + 0.8, layout="constrained")
    axes: Any = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for r, pose_type in enumerate(study.pose_types):
        for c, plane in enumerate(planes):
            axis = axes[r, c]
            _boxes(axis, table, str(pose_type), plane)
            title = f"{pose_type} motion" + (f", plane {plane}" if plane else "")
            axis.set_title(title, fontsize=9)
            axis.set_ylim(bottom=0.0)
            axis.grid(axis="y", linewidth=0.6, alpha=0.5)
            axis.set_axisbelow(True)
        axes[r, 0].set_ylabel("normal error, deg")
    _label_x(axes[-1], table)
    figure.suptitle(study.title, fontsize=11)
    if len(study.methods) > 1 and len(study.sigmas) > 1:
        handles = [_swatch(m) for m in range(len(study.methods))]
        entry = SWATCH_INCHES + LETTER_INCHES * max(map(len, study.methods))
        fitting = min(len(study.methods), max(1, int(figure.get_figwidth() / entry)))
        figure.legend(handles, study.methods, loc="outside lower center", ncols=fitting, frameon=False)
    data = io.BytesIO()
    figure.savefig(data, format=file_format, dpi=150, metadata=UNDATED.get(file_format))
    return data.getvalue()


def _boxes(axis: Any, table: StudyTable, pose_type: str, plane: int) -> None:
    study = table.study
    methods = len(study.methods)
    for s, sigma in enumerate(study.sigmas):
        for m, method in enumerate(study.methods):
            cell = table.cell(pose_type=pose_type, sigma=sigma, method=method, plane=plane)
            if len(study.sigmas) == 1:
                position, width = float(m), 0.6
            else:
                width = 0.8 / methods
                position = s + (m - 0.5 * (methods - 1)) * width
            if cell.count:
                _box(axis, cell, position, 0.85 * width, METHOD_COLOURS[m % len(METHOD_COLOURS)])


def _box(axis: Any, cell: StudyCell, position: float, width: float, colour: str) -> None:
    from matplotlib import rcParams

    statistics = {
        "med": cell.median_deg,
        "q1": cell.q25_deg,
        "q3": cell.q75_deg,
        "whislo": cell.whisker_low_deg,
        "whishi": cell.whisker_high_deg,
    }
    axis.bxp(
        [statistics],
        positions=[position],
        widths=width,
        showfliers=False,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": colour, "alpha": 0.45, "edgecolor": colour},
        medianprops={"color": rcParams["text.color"]},
        whiskerprops={"color": colour},
        capprops={"color": colour},
    )


def _label_x(axes: Any, table: StudyTable) -> None:
    study = table.study
    for axis in axes:
        if len(study.sigmas) == 1:
            axis.set_xticks(np.arange(len(study.methods)), study.methods, fontsize=8)
            axis.set_xlabel(f"noise {study.sigmas[0]:g} {study.unit} on {study.noise}")
        else:
            axis.set_xticks(np.arange(len(study.sigmas)), [f"{s:g}" for s in study.sigmas])
            axis.set_xlabel(f"noise on {study.noise}, {study.unit}")


def _swatch(index: int) -> Any:
    from matplotlib.patches import Patch

    return Patch(facecolor=METHOD_COLOURS[index % len(METHOD_COLOURS)], alpha=0.45)
