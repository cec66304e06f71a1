"""The HTML report: one page without network access, with an interactive 3D view of every pair."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.report.tables import below, measured_words
from rigkit.validation.tables import Cell, Column, Table

__all__ = ["PairSection", "build_page", "facts_html", "page_html", "scene_of", "table_html"]

PYRAMID_DEPTH = 0.15
"""Depth of a drawn camera pyramid, relative to the median distance of the points."""


def table_html(table: Table) -> str:
    """Return a table of plain data as HTML: sigmas after ±, the paper's number in brackets, verdicts in colour."""
    words = [any(isinstance(row[j].value, str) for row in table.rows) for j in range(len(table.columns))]
    head = "".join(
        f"<th{' class=text' if text else ''}>{html.escape(f'{c.label}, {c.unit}' if c.unit else c.label)}</th>"
        for c, text in zip(table.columns, words, strict=True)
    )
    body = "".join(
        f"<tr>{''.join(_cell(c, column) for c, column in zip(row, table.columns, strict=True))}</tr>"
        for row in table.rows
    )
    note = f'<p class="soft">{html.escape(below(table))}</p>' if below(table) else ""
    return (
        f'<h3>{html.escape(table.title)}</h3><div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>{note}"
    )


def _cell(cell: Cell, column: Column) -> str:
    if isinstance(cell.value, str):
        kind = "fail" if cell.failed else "pass" if cell.value == "pass" else "text"
        return f'<td class="{kind}">{html.escape(cell.value)}</td>'
    known = cell.value is not None and np.isfinite(cell.value)
    words = measured_words(cell.value, cell.sigma, column.decimals) if cell.value is not None and known else "–"
    if cell.best:
        words = f"<b>{words}</b>"
    if cell.paper is not None:
        words += f' <span class="soft">({html.escape(cell.paper)})</span>'
    return f'<td class="fail">{words}</td>' if cell.failed else f"<td>{words}</td>"


@dataclass(frozen=True, eq=False, slots=True)
class PairSection:
    """What the page shows of one pair."""

    pair_id: str
    lead: str
    tables: tuple[Table, ...]
    images: tuple[tuple[str, str, bytes], ...]
    """(caption, MIME type, bytes)."""
    scene: Mapping[str, Any] | None
    notes: tuple[str, ...] = ()


def build_page(
    title: str,
    lead: str,
    passed: bool,
    summary: Sequence[Table],
    pairs: Sequence[PairSection],
    provenance: Mapping[str, str],
) -> str:
    """Return the page as text; everything it needs is inside it."""
    script = resources.files("rigkit.report").joinpath("viewer.js").read_text(encoding="utf-8")
    verdict = "pass" if passed else "fail"
    words = "all checks passed" if passed else "a check failed"
    links = "".join(f'<a href="#{html.escape(p.pair_id)}">{html.escape(p.pair_id)}</a>' for p in pairs)
    return page_html(
        title,
        f'<p class="lead">{html.escape(lead)}</p>'
        f'<p><span class="verdict {verdict}">{words}</span></p><nav>{links}</nav>'
        f'<section id="summary"><h2>Summary</h2>{"".join(table_html(t) for t in summary)}</section>'
        f"{''.join(_section(p, i) for i, p in enumerate(pairs))}{facts_html(provenance)}<script>{script}</script>",
    )


def page_html(title: str, body: str) -> str:
    """Return a whole page around `body`, with the style of all pages inside it."""
    style = resources.files("rigkit.report").joinpath("page.css").read_text(encoding="utf-8")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<title>{html.escape(title)}</title><style>{style}</style></head><body>"
        f"<h1>{html.escape(title)}</h1>{body}</body></html>\n"
    )


def facts_html(provenance: Mapping[str, str]) -> str:
    """Return the section that says what a page was made from."""
    facts = "".join(
        f'<tr><td>{html.escape(k)}</td><td class="text">{html.escape(v)}</td></tr>' for k, v in provenance.items()
    )
    return f'<section id="provenance"><h2>Provenance</h2><table><tbody>{facts}</tbody></table></section>'


def _section(pair: PairSection, number: int) -> str:
    figures = "".join(
        f'<figure><img alt="{html.escape(caption)}" src="data:{mime};base64,{base64.b64encode(data).decode()}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, mime, data in pair.images
    )
    notes = "".join(f"<li>{html.escape(n)}</li>" for n in pair.notes)
    view = ""
    if pair.scene is not None:
        # "</" must not end the script element early.
        data = json.dumps(pair.scene, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
        boxes = "".join(
            f'<label><input type="checkbox" data-show="{what}" checked> {what}</label>'
            for what in ("normals", "cameras", "planes")
        )
        view = (
            f'<div class="view"><canvas tabindex="0" data-scene="scene{number}" '
            f'aria-label="3D view: drag to turn, wheel to zoom"></canvas>{boxes}'
            f'<span class="soft">drag to turn, wheel to zoom, double click to reset</span></div>'
            f'<script type="application/json" id="scene{number}">{data}</script>'
        )
    return (
        f'<section id="{html.escape(pair.pair_id)}"><h2>{html.escape(pair.pair_id)}</h2>'
        f'<p class="lead">{html.escape(pair.lead)}</p>{"".join(table_html(t) for t in pair.tables)}'
        f"{f'<ul class=notes>{notes}</ul>' if notes else ''}{view}{figures}</section>"
    )


def scene_of(reconstruction: Reconstruction) -> dict[str, Any]:
    """Return the oriented cloud, the cameras and the board planes as the page's 3D view reads them."""
    cloud = reconstruction.cloud
    depth = PYRAMID_DEPTH * float(np.median(np.linalg.norm(cloud.points_mm, axis=1)))
    frames = ((Rigid3.identity(), "camera 1"), (reconstruction.cam2_from_cam1.inverse(), "camera 2"))
    planes = [
        {"board": index, "corners": _rounded(_outline(cloud.points_mm[cloud.board_index == index]), 2)}
        for index in range(len(cloud.board_ids))
        if (cloud.board_index == index).sum() >= 3
    ]
    pyramid = depth * np.array([[0, 0, 0], [-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]])
    return {
        "points": _rounded(cloud.points_mm, 2),
        "normals": _rounded(cloud.normals, 4),
        "board": [int(b) for b in cloud.board_index],
        "boards": list(cloud.board_ids),
        "cameras": [{"name": name, "corners": _rounded(frame.apply(pyramid), 2)} for frame, name in frames],
        "planes": planes,
        "square_mm": float(np.mean([b.square_x_mm for b in reconstruction.boards])),
    }


def _outline(points: FloatArray) -> FloatArray:
    """Return the corners of the smallest box, along the principal axes, around points that lie in a plane."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2][:2]
    local = (points - centre) @ axes.T
    (x0, y0), (x1, y1) = local.min(axis=0), local.max(axis=0)
    return np.asarray(centre + np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) @ axes)


def _rounded(values: FloatArray, digits: int) -> list[list[float]]:
    return [[round(float(v), digits) for v in row] for row in values]
