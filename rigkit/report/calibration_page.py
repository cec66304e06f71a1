"""A calibration as an HTML page: how good it is first, then what it rests on, picture by picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.core.arrays import Pixels
from rigkit.core.tables import Cell, Column, Table
from rigkit.io.images import Image
from rigkit.planning.plan import Plan
from rigkit.report.calibration_drawings import coverage_svg, pattern_svg, residuals_svg, uncertainty_svg
from rigkit.report.plan_page import shown_views
from rigkit.report.render import data_uri, drawing, render, shown_table

__all__ = ["CalibrationSection", "build_calibration_page", "thumbnail_jpeg"]

THUMBNAIL_PX = 320
"""Width of the thumbnails: twice what the page shows, for dense screens."""
PAGE_JPEG_QUALITY = 70
KEPT_COLOUR, LEFT_OUT_COLOUR = (60, 220, 60), (60, 60, 255)
"""Blue, green, red of the corners in thumbnails."""
DRAWINGS: tuple[tuple[str, Callable[[Calibration], str]], ...] = (
    ("Projection uncertainty", uncertainty_svg),
    ("Residuals", residuals_svg),
    ("What the residuals have in common", pattern_svg),
    ("Coverage", coverage_svg),
)
VERDICTS = {"good": "pass", "look": "look", "bad": "fail"}


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationSection:
    """One calibrated camera on the page: thumbnails are JPEG by image name; images without one are shown without.
    `plan` are the pictures that would help most next; None shows none."""

    name: str
    calibration: Calibration
    thumbnails: Mapping[str, bytes] = field(default_factory=dict)
    plan: Plan | None = None


def build_calibration_page(
    title: str,
    lead: str,
    sections: Sequence[CalibrationSection],
    provenance: Mapping[str, str],
    summary: Sequence[Table] = (),
) -> str:
    """Return the page as text; everything it needs is inside it. `summary` are tables of what the cameras share."""
    return render(
        "calibration.html",
        title=title,
        lead=lead,
        summary=[shown_table(table) for table in summary],
        sections=[_shown(section) for section in sections],
        provenance=provenance,
    )


def thumbnail_jpeg(image: Image, views: Sequence[ViewResult] = ()) -> bytes:
    """Return a small picture of `image` ((H, W) or (H, W, 3) RGB) with the corners of its views: used ones as dots,
    those left out as rings."""
    zoom = THUMBNAIL_PX / image.shape[1]
    size = (THUMBNAIL_PX, max(round(image.shape[0] * zoom), 1))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float64)
    if image.dtype != np.uint8:
        small *= 255.0 / max(float(np.quantile(small, 0.999)), 1.0)
    picture = small.clip(0.0, 255.0).astype(np.uint8)
    canvas = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR if picture.ndim == 2 else cv2.COLOR_RGB2BGR)
    for view in views:
        for (u, v), kept in zip((view.pixels + 0.5) * zoom - 0.5, view.kept, strict=True):
            place = (round(float(u) * 16), round(float(v) * 16))
            if kept:
                cv2.circle(canvas, place, 24, KEPT_COLOUR, -1, cv2.LINE_AA, 4)
            else:
                cv2.circle(canvas, place, 72, LEFT_OUT_COLOUR, 2, cv2.LINE_AA, 4)
    return bytes(cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, PAGE_JPEG_QUALITY])[1])


def _shown(section: CalibrationSection) -> dict[str, Any]:
    """Return one camera in words and pictures, as the template shows it."""
    c = section.calibration
    sources = {name: data_uri("image/jpeg", data) for name, data in section.thumbnails.items()}
    return {
        "name": section.name,
        "heldout": "not available (too few images)" if c.heldout_rms_px is None else f"{c.heldout_rms_px:.3f} px",
        "training": f"{c.rms_px:.3f} px",
        "basis": _basis(c),
        "findings": _findings(c),
        "drawings": [(name, drawing(draw(c))) for name, draw in DRAWINGS],
        "next": [] if section.plan is None else shown_views(section.plan, _kept(c)),
        "next_gain": "" if section.plan is None else f"{100.0 * section.plan.gain:.0f}",
        "tables": [shown_table(table) for table in (_parameters(c), _candidates(c), _boards(c))],
        "views": _views(c, sources),
        "dropped": [(image, reason, sources.get(image)) for image, reason in c.dropped],
    }


def _kept(c: Calibration) -> Pixels:
    return np.concatenate([view.pixels[view.kept] for view in c.views])


def _basis(c: Calibration) -> str:
    width, height = c.camera.size_px
    return (
        f"{c.camera.model} camera, {width} x {height} px, {c.corner_count} corners in {len(c.views)} views "
        f"of {len({v.image for v in c.views})} images, {len(c.outliers)} corners and {len(c.dropped)} images left out; "
        f"a corner scatters by {c.sigma_px:.3f} px per axis; solver: {c.convergence.reason} after "
        f"{c.convergence.iterations} steps."
    )


def _findings(c: Calibration) -> list[tuple[str, str, str]]:
    """Return severity, colour and words of each finding."""
    return [(str(found.severity), VERDICTS[found.severity], found.text) for found in c.verdicts]


def _parameters(c: Calibration) -> Table:
    rows = tuple(
        (Cell(name), Cell(f"{value:.9g}"), Cell(f"{sigma:.2g}"))
        for name, value, sigma in zip(c.camera.parameter_names(), c.camera.parameters, c.parameter_sigmas, strict=True)
    )
    return Table("parameters", "Parameters", (Column("name"), Column("value"), Column("standard deviation")), rows)


def _candidates(c: Calibration) -> Table:
    columns = (
        Column("tried"),
        Column("numbers", "", 0),
        Column("held-out RMS", "px", 4),
        Column("training RMS", "px", 4),
        Column("taken"),
        Column("why"),
    )
    rows = tuple(
        (
            Cell(option.name),
            Cell(float(option.parameter_count) if option.parameter_count else None),
            Cell(option.heldout_rms_px, best=option.chosen),
            Cell(option.rms_px),
            Cell("taken" if option.chosen else ""),
            Cell(option.reason),
        )
        for option in c.candidates
    )
    none = (Cell("nothing but what was asked for"), *[Cell(None)] * 3, Cell(""), Cell(""))
    return Table("candidates", "Models and board shapes tried", columns, rows or (none,))


def _boards(c: Calibration) -> Table:
    columns = (Column("board"), Column("shape"), Column("off a plane by", "mm"), Column("x longer than y by", "%"))
    rows = tuple((Cell(b.board_id), Cell(b.kind), Cell(b.bow_mm), Cell(100.0 * b.aspect)) for b in c.boards)
    return Table("boards", "Boards as the solution has them", columns, rows)


def _views(c: Calibration, sources: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of the images: each image is shown with the first of its boards."""
    middle_mm = {board.board_id: board.points_mm.mean(axis=0) for board in c.boards}
    shown: set[str] = set()
    rows: list[dict[str, Any]] = []
    for view in c.views:
        rows.append(
            {
                "image": view.image,
                "board_id": view.board_id,
                "picture": None if view.image in shown else sources.get(view.image),
                "rms_px": view.rms_px,
                "used": int(view.kept.sum()),
                "left_out": int((~view.kept).sum()),
                "distance_mm": float(np.linalg.norm(view.cam_from_board.apply(middle_mm[view.board_id]))),
                "tilt_deg": np.degrees(np.arccos(np.clip(abs(view.cam_from_board.rotation[2, 2]), 0.0, 1.0))),
                "remarks": _remarks(c, view.image),
            }
        )
        shown.add(view.image)
    return rows


def _remarks(c: Calibration, image: str) -> str:
    """Return what the verdicts say of one image."""
    return " ".join(found.text for found in c.verdicts if found.image == image)
