"""A calibration as an HTML page: how good it is first, then what it rests on, picture by picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from rigkit.calibration.coverage import covered_by_boards
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.uncertainty import uncertainty_map
from rigkit.core.arrays import Pixels
from rigkit.core.findings import Finding, worst
from rigkit.core.printing import brief
from rigkit.core.tables import Cell, Column, Table
from rigkit.io.images import Image
from rigkit.planning.plan import Plan
from rigkit.report.calibration_charts import histogram_svg, images_svg, lens_svg, radius_svg
from rigkit.report.calibration_drawings import MAP_GRID, coverage_svg, pattern_svg, residuals_svg, uncertainty_svg
from rigkit.report.plan_page import shown_views
from rigkit.report.render import data_uri, drawing, render, shown_table
from rigkit.report.rig_tables import rig_basis, rig_reach, rig_tables
from rigkit.report.scene_view import boards_scene, rig_scene
from rigkit.report.tables import rounded_words
from rigkit.validation.check import Check

THUMBNAILS_PX = (640, 320)
"""Width of the thumbnails: large ones can be enlarged, small ones are twice what the page shows, for dense screens."""
MAX_LARGE = 40
"""More images than this get small thumbnails: the page stays below 5 MB."""
PAGE_JPEG_QUALITY = 70
KEPT_COLOUR, LEFT_OUT_COLOUR = (60, 220, 60), (60, 60, 255)
"""Blue, green, red of the corners in thumbnails."""
DRAWINGS: tuple[tuple[str, Callable[[Calibration], str]], ...] = (
    ("Projection uncertainty", uncertainty_svg),
    ("Residuals", residuals_svg),
    ("What the residuals have in common", pattern_svg),
    ("Coverage", coverage_svg),
    ("RMS by image", images_svg),
    ("Error by distance from the centre", radius_svg),
    ("Residuals and chance", histogram_svg),
    ("The lens", lens_svg),
)
IN_PX = ("fx", "fy", "cx", "cy")
MAX_RATIO_BEYOND = 3.0
"""Where the projection is no worse than so many times the worst place that boards reached, all of the image serves."""
BADGE_WORDS = {"good": "good", "look": "usable, with care", "bad": "do not use"}
VERDICTS = {"good": "pass", "look": "look", "bad": "fail"}


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationSection:
    """One calibrated camera on the page: thumbnails are JPEG by image name; images without one are shown without.
    `plan` are the pictures that would help most next; None shows none."""

    name: str
    calibration: Calibration
    thumbnails: Mapping[str, bytes] = field(default_factory=dict)
    plan: Plan | None = None

    __repr__ = brief


def build_calibration_page(
    title: str,
    lead: str,
    sections: Sequence[CalibrationSection],
    provenance: Mapping[str, str],
    rig: RigCalibration | None = None,
    checks: Sequence[Check] = (),
) -> str:
    """Return the page as text; everything it needs is inside it. `rig` is what the cameras share, `checks` what a
    person measured of it."""
    return render(
        "calibration.html",
        title=title,
        lead=lead,
        shared=None if rig is None else _shared(rig, checks),
        sections=[_shown(section) for section in sections],
        provenance=provenance,
    )


def thumbnail_jpeg(image: Image, views: Sequence[ViewResult] = (), *, count: int = 1) -> bytes:
    """Return a small picture of `image` ((H, W) or (H, W, 3) RGB), one of `count` on the page, with the corners of its
    views: used ones as dots, those left out as rings."""
    wide = THUMBNAILS_PX[count > MAX_LARGE]
    zoom = wide / image.shape[1]
    size = (wide, max(round(image.shape[0] * zoom), 1))
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


def _shared(rig: RigCalibration, checks: Sequence[Check]) -> dict[str, Any]:
    """Return what the cameras share, as the template shows it."""
    return {
        "heldout": "not available (too few frames)" if rig.heldout_rms_px is None else f"{rig.heldout_rms_px:.3f} px",
        "training": f"{rig.rms_px:.3f} px",
        "findings": _findings(rig.verdicts),
        "told": _told(rig.verdicts, rig_reach(rig, checks)),
        "basis": rig_basis(rig),
        "scene": rig_scene(rig),
        "tables": [shown_table(table) for table in rig_tables(rig, checks)],
    }


def _shown(section: CalibrationSection) -> dict[str, Any]:
    """Return one camera in words and pictures, as the template shows it."""
    c = section.calibration
    sources = {name: data_uri("image/jpeg", data) for name, data in section.thumbnails.items()}
    return {
        "name": section.name,
        "heldout": "not available (too few images)" if c.heldout_rms_px is None else f"{c.heldout_rms_px:.3f} px",
        "training": f"{c.rms_px:.3f} px",
        "basis": _basis(c),
        "findings": _findings(c.verdicts),
        "told": _told(c.verdicts, _reach(c)),
        "scene": boards_scene(c.views, c.boards),
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


def _findings(found: Sequence[Finding]) -> list[tuple[str, str, str]]:
    """Return severity, colour and words of each finding."""
    return [(str(one.severity), VERDICTS[one.severity], one.text) for one in found]


def _told(found: Sequence[Finding], sentence: str) -> dict[str, str]:
    """Return the verdict that stands first: the gravest finding's severity, and the result in the user's units."""
    severity = worst(found)
    return {"words": BADGE_WORDS[severity], "colour": VERDICTS[severity], "headline": sentence}


def _reach(c: Calibration) -> str:
    """Say how sure the projection is where boards were and beyond, in pixels."""
    grid = uncertainty_map(c, grid=MAP_GRID)
    known = np.isfinite(grid.worst_px)
    inside = covered_by_boards(c, grid.pixels) & known
    if not inside.any():
        return ""
    within, beyond = grid.worst_px[inside], grid.worst_px[known & ~inside]
    words = (
        f"A far point is projected to ±{np.median(within):.2g} px where boards were (±{within.max():.2g} px at worst; "
        "one standard deviation)"
    )
    if not beyond.size:
        return words + "."
    worst = float(beyond.max())
    if worst < MAX_RATIO_BEYOND * within.max():
        return words + f", and to ±{worst:.2g} px at worst outside: use the whole image."
    return words + (
        f", and to ±{worst:.2g} px at worst outside: use the part inside the dashed line only, or add pictures with "
        "the board at the border, tilted by 30 degrees."
    )


def _parameters(c: Calibration) -> Table:
    rows = tuple(
        (Cell(name), Cell(rounded_words(float(value), float(sigma))), Cell("px" if name in IN_PX else ""))
        for name, value, sigma in zip(c.camera.parameter_names(), c.camera.parameters, c.parameter_sigmas, strict=True)
    )
    columns = (Column("name"), Column("value and standard deviation"), Column("unit"))
    return Table("parameters", "Parameters", columns, rows, "The file has every digit.")


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
