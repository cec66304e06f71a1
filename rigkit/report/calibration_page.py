"""A calibration as an HTML page: how good it is first, then what it rests on, picture by picture."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import cv2
import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.io.images import Image
from rigkit.report.calibration_drawings import coverage_svg, pattern_svg, residuals_svg, uncertainty_svg
from rigkit.report.page import facts_html, page_html, table_html
from rigkit.validation.tables import Cell, Column, Table

__all__ = ["CalibrationSection", "build_calibration_page", "thumbnail_jpeg"]

THUMBNAIL_PX = 320
"""Width of the thumbnails: twice what the page shows, for dense screens."""
JPEG_QUALITY = 70
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
    """One calibrated camera on the page: thumbnails are JPEG by image name; images without one are shown without."""

    name: str
    calibration: Calibration
    thumbnails: Mapping[str, bytes] = field(default_factory=dict)


def build_calibration_page(
    title: str,
    lead: str,
    sections: Sequence[CalibrationSection],
    provenance: Mapping[str, str],
    summary: Sequence[Table] = (),
) -> str:
    """Return the page as text; everything it needs is inside it. `summary` are tables of what the cameras share."""
    several = len(sections) > 1
    links = "".join(f'<a href="#{escape(s.name)}">{escape(s.name)}</a>' for s in sections)
    return page_html(
        title,
        f'<p class="lead">{escape(lead)}</p>{f"<nav>{links}</nav>" if several else ""}'
        f"{''.join(table_html(t) for t in summary)}"
        f"{''.join(_section(s, heading=several) for s in sections)}{facts_html(provenance)}",
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
    return bytes(cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def _section(section: CalibrationSection, *, heading: bool) -> str:
    c = section.calibration
    drawings = "".join(f"<div><h3>{escape(name)}</h3>{draw(c)}</div>" for name, draw in DRAWINGS)
    return (
        f'<section id="{escape(section.name)}">{f"<h2>{escape(section.name)}</h2>" if heading else ""}'
        f'{_headline(c)}{_verdicts(c)}<div class="drawings">{drawings}</div>'
        f"{table_html(_parameters(c))}{table_html(_candidates(c))}{table_html(_boards(c))}"
        f"{_views(section)}{_dropped(section)}</section>"
    )


def _headline(c: Calibration) -> str:
    width, height = c.camera.size_px
    held = "not available (too few images)" if c.heldout_rms_px is None else f"{c.heldout_rms_px:.3f} px"
    return (
        f'<p class="headline">held-out RMS <b>{held}</b> <span class="soft">training RMS {c.rms_px:.3f} px</span></p>'
        f"<p>{escape(c.camera.model)} camera, {width} x {height} px, {c.corner_count} corners in {len(c.views)} views "
        f"of {len({v.image for v in c.views})} images, {len(c.outliers)} corners and {len(c.dropped)} images left out; "
        f"a corner scatters by {c.sigma_px:.3f} px per axis; solver: {escape(c.convergence.reason)} after "
        f'{c.convergence.iterations} steps.</p><p class="soft">Both RMS are sqrt(mean |residual|²) over corners. Held '
        "out: on images that took no part, with the lens frozen and only the board's pose fitted.</p>"
    )


def _verdicts(c: Calibration) -> str:
    lines = []
    for verdict in c.verdicts:
        colour = VERDICTS[verdict.severity]
        lines.append(f'<p><span class="verdict {colour}">{verdict.severity}</span> {escape(verdict.text)}</p>')
    return "".join(lines)


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


def _views(section: CalibrationSection) -> str:
    c = section.calibration
    head = "".join(
        f"<th{' class=text' if k in (1, 2, 8) else ''}>{words}</th>"
        for k, words in enumerate(
            ("", "image", "board", "RMS, px", "corners used", "left out", "distance, mm", "tilt, deg", "remark")
        )
    )
    shown: set[str] = set()
    rows = []
    for view in c.views:
        remarks = " ".join(v.text for v in c.verdicts if v.image == view.image)
        middle = view.cam_from_board.apply(
            next(b.points_mm for b in c.boards if b.board_id == view.board_id).mean(axis=0)
        )
        distance = float(np.linalg.norm(middle))
        tilt = np.degrees(np.arccos(np.clip(abs(view.cam_from_board.rotation[2, 2]), 0.0, 1.0)))
        cells = [
            _picture(section, view.image) if view.image not in shown else "<td></td>",
            f'<td class="text">{escape(view.image)}</td><td class="text">{escape(view.board_id)}</td>',
            f"<td{' class=fail' if remarks else ''}>{view.rms_px:.3f}</td><td>{int(view.kept.sum())}</td>",
            f"<td>{int((~view.kept).sum())}</td><td>{distance:.0f}</td><td>{tilt:.0f}</td>",
            f'<td class="text words">{escape(remarks)}</td>',
        ]
        shown.add(view.image)
        rows.append(f"<tr>{''.join(cells)}</tr>")
    note = '<p class="soft">Tilt: between the board and the image plane.</p>'
    return _picture_table("Images", head, "".join(rows)) + note


def _dropped(section: CalibrationSection) -> str:
    rows = "".join(
        f'<tr>{_picture(section, image)}<td class="text">{escape(image)}</td>'
        f'<td class="text words">{escape(reason)}</td></tr>'
        for image, reason in section.calibration.dropped
    )
    if not rows:
        return ""
    return _picture_table("Left out", "<th></th><th class=text>image</th><th class=text>why</th>", rows)


def _picture_table(title: str, head: str, rows: str) -> str:
    return (
        f'<h3>{title}</h3><div class="scroll"><table class="pictures"><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _picture(section: CalibrationSection, image: str) -> str:
    data = section.thumbnails.get(image)
    if data is None:
        return "<td></td>"
    source = f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
    return f'<td><img alt="{escape(image)}" loading="lazy" src="{source}"></td>'
