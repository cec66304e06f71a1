"""The HTML page of a calibration: verdict first, then tables, drawings and images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.findings import most_severe_first
from rigkit.core.printing import brief
from rigkit.core.tables import Table
from rigkit.io.media.images import Image
from rigkit.planning.plan import Plan
from rigkit.report.pages.calibration_charts import histogram_svg, images_svg, lens_svg, radius_svg
from rigkit.report.pages.calibration_drawings import coverage_svg, pattern_svg, residuals_svg, uncertainty_svg
from rigkit.report.pages.calibration_facts import (
    IMAGES_KEY,
    LEFT_OUT_KEY,
    NEXT_KEY,
    camera_facts,
    next_words,
    rig_facts,
    training_note,
)
from rigkit.report.pages.page_facts import PageFacts, verdict_line
from rigkit.report.pages.plan_page import views_context
from rigkit.report.pictures.scene_view import boards_scene, rig_scene
from rigkit.report.render import data_uri, drawing, render, table_context
from rigkit.validation.check import Check

THUMBNAILS_PX = (640, 320)
"""Width of large and small thumbnails; the small ones are twice as wide as shown, for high-resolution screens."""
MAX_LARGE = 40
"""More images get small thumbnails, so that the page stays below 5 MB."""
PAGE_JPEG_QUALITY = 70
KEPT_COLOUR, LEFT_OUT_COLOUR = (60, 220, 60), (60, 60, 255)
"""BGR colours of the corners in thumbnails."""
DRAWINGS: tuple[tuple[str, Callable[[Calibration], str]], ...] = (
    ("Projection uncertainty", uncertainty_svg),
    ("Residuals", residuals_svg),
    ("Systematic residuals", pattern_svg),
    ("Coverage", coverage_svg),
    ("RMS by image", images_svg),
    ("Error against distance from the centre", radius_svg),
    ("Distribution of residuals", histogram_svg),
    ("Lens curve", lens_svg),
)
VERDICTS = {"good": "pass", "look": "look", "bad": "fail"}


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationSection:
    """One calibrated camera on the page.

    Attributes
    ----------
    thumbnails : JPEG by image name; not every image needs one.
    plan : pictures to take next, or None.
    """

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
    """Return the page as self-contained HTML.

    `rig` is the rig of the cameras; `checks` compare it with measurements.
    """
    return render(
        "calibration.html",
        title=title,
        lead=lead,
        shared=None if rig is None else _rig_context(rig, checks),
        sections=[_section_context(section) for section in sections],
        provenance=provenance,
    )


def thumbnail_jpeg(image: Image, views: Sequence[ViewResult] = (), *, count: int = 1) -> bytes:
    """Return a thumbnail of `image` ((H, W) or (H, W, 3) RGB), one of `count` on the page, with the corners of its
    views: inliers as dots, outliers as rings."""
    wide = THUMBNAILS_PX[count > MAX_LARGE]
    zoom = wide / image.shape[1]
    size = (wide, max(round(image.shape[0] * zoom), 1))
    picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if picture.dtype != np.uint8:
        brightest = max(float(np.quantile(picture, 0.999)), 1.0)
        picture = (picture * (255.0 / brightest)).clip(0.0, 255.0).astype(np.uint8)
    canvas = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR if picture.ndim == 2 else cv2.COLOR_RGB2BGR)
    for view in views:
        for (u, v), kept in zip((view.pixels + 0.5) * zoom - 0.5, view.kept, strict=True):
            place = (round(float(u) * 16), round(float(v) * 16))
            if kept:
                cv2.circle(canvas, place, 24, KEPT_COLOUR, -1, cv2.LINE_AA, 4)
            else:
                cv2.circle(canvas, place, 72, LEFT_OUT_COLOUR, 2, cv2.LINE_AA, 4)
    return bytes(cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, PAGE_JPEG_QUALITY])[1])


def _rig_context(rig: RigCalibration, checks: Sequence[Check]) -> dict[str, Any]:
    """Return the rig for the template."""
    facts = rig_facts(rig, checks, {})
    return {
        **_summary(rig, facts, "frames"),
        "scene": rig_scene(rig),
        "tables": [table_context(table) for table in facts.tables],
    }


def _section_context(section: CalibrationSection) -> dict[str, Any]:
    """Return one camera for the template."""
    c = section.calibration
    facts = camera_facts(c, section.plan)
    sources = {name: data_uri("image/jpeg", data) for name, data in section.thumbnails.items()}
    return {
        "name": section.name,
        **_summary(c, facts, "images"),
        "scene": boards_scene(c.views, c.boards),
        "drawings": [(name, drawing(draw(c))) for name, draw in DRAWINGS],
        "next": [] if section.plan is None else views_context(section.plan, c.corners.used[0]),
        "next_words": "" if section.plan is None else next_words(section.plan),
        "tables": [table_context(table, _pictures(table, sources)) for table in facts.tables if table.key != NEXT_KEY],
    }


def _pictures(table: Table, sources: Mapping[str, str]) -> list[str | None]:
    """Return the pictures of the rows of a table of images, each image once; [] for other tables."""
    if table.key not in (IMAGES_KEY, LEFT_OUT_KEY):
        return []
    names = [str(row[0].value) for row in table.rows]
    return [sources.get(name) if name not in names[:k] else None for k, name in enumerate(names)]


def _summary(c: Calibration | RigCalibration, facts: PageFacts, taken: str) -> dict[str, Any]:
    """Return the summary of a camera or a rig for the template: errors, findings (the most severe first) and basis."""
    held, note = c.heldout_rms_px, training_note(c.rms_px, c.heldout_rms_px)
    return {
        "heldout": f"not available (too few {taken})" if held is None else f"{held:.3f} px",
        "training": f"{c.rms_px:.3f} px" + (f" ({note})" if note else ""),
        "findings": [(str(one.severity), VERDICTS[one.severity], one.text) for one in most_severe_first(c.verdicts)],
        "verdict_line": verdict_line(facts),
        "basis": facts.basis,
    }
