"""A plan of views in words, as drawings of the board in the image, and as HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels, sampling_step, without_nan
from rigkit.core.boards import Board
from rigkit.core.tables import Column, Table, cells
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.candidates import placement
from rigkit.planning.plan import Plan
from rigkit.report import svg
from rigkit.report.pages.page_facts import PageFacts
from rigkit.report.pictures.board_sheet import black_squares
from rigkit.report.render import drawing, render, table_context
from rigkit.report.svg import INK, MARK

VIEW_WIDTH = 320.0
"""Width of a drawn view, in units of the drawing."""
CIRCLE_CORNERS = 12
MAX_DOTS = 1500
"""Maximum number of earlier corners drawn; more are subsampled."""


def plan_words(plan: Plan) -> list[str]:
    """Return one line for each view, with the error after it."""
    unit, several = plan.goal.unit, len({v.board.board_id for v in plan.views}) > 1
    lines = []
    for number, view in enumerate(plan.views, start=1):
        which = f" (board '{view.board.board_id}')" if several else ""
        where = str(placement(view.camera, view.board, view.cam_from_board))
        if view.seen_by:
            own, *others = (f"'{name}'" for name in view.seen_by)
            also = f"; also seen by {' and '.join(others)}" if others else ""
            where = f"before camera {own}: {where}{also}"
        lines.append(f"{number}. {where}{which}: {view.error:.3g} {unit}")
    return lines


def plan_to_dict(plan: Plan) -> dict[str, Any]:
    """Return the plan as JSON values."""
    return {
        "goal": plan.goal.what,
        "unit": plan.goal.unit,
        "error_now": without_nan(plan.error),
        "views": [
            {
                "board": view.board.board_id,
                "cam_from_board": view.cam_from_board.matrix()[:3].tolist(),
                "place": where.place,
                "distance_mm": where.distance_mm,
                "tilt_deg": where.tilt_deg,
                "nearer": where.nearer,
                "upright": where.upright,
                "outline_px": [[float(u), float(v)] for u, v in where.outline_px if np.isfinite(u)],
                "words": str(where),
                "error_then": view.error,
            }
            | ({"camera": view.seen_by[0], "seen_by": list(view.seen_by)} if view.seen_by else {})
            for view, where in ((v, placement(v.camera, v.board, v.cam_from_board)) for v in plan.views)
        ],
    }


def plan_table(plan: Plan) -> Table:
    """Return the table of the goal's error after each view."""
    heads = (Column("more images"), Column(plan.goal.what, plan.goal.unit), Column("reduction", "%", 0))
    errors = [plan.error, *(view.error for view in plan.views)]
    # Without pictures the error is infinite: changes are relative to the first finite error.
    first = next((k for k, error in enumerate(errors) if np.isfinite(error)), len(errors))
    rows = tuple(
        cells(str(k), float(f"{errors[k]:.4g}"), 100.0 * (1.0 - errors[k] / errors[first]))
        for k in range(first, len(errors))
    )
    return Table("plan", "Gain of the images", heads, rows)


def view_svg(plan: Plan, index: int, taken: Pixels | None = None) -> str:
    """Draw the board as it should be seen, over the earlier corners `taken` (N, 2)."""
    view = plan.views[index]
    camera = view.camera
    zoom = VIEW_WIDTH / camera.size_px[0]
    where = placement(camera, view.board, view.cam_from_board)
    out = [svg.image_ground(str(where), VIEW_WIDTH, zoom * camera.size_px[1])]
    if taken is not None and len(taken):
        path = svg.dots(zoom * taken[:: sampling_step(len(taken), MAX_DOTS)])
        out.append(f'<path d="{path}" stroke="{INK}" stroke-opacity="0.35" stroke-width="2" stroke-linecap="round"/>')
    out += [
        f'<path d="{_path(zoom * square)}Z" fill="{MARK}" fill-opacity="0.75"/>'
        for square in printed_outlines(camera, view.board, view.cam_from_board)
    ]
    out.append(f'<path d="{_path(zoom * where.outline_px)}Z" fill="none" stroke="{MARK}" stroke-width="2"/></svg>')
    return "".join(out)


def printed_outlines(camera: Camera, board: Board, cam_from_board: Rigid3) -> list[Pixels]:
    """Return the image outlines (K, 2) of the printed shapes of a board that the lens sees completely."""
    ink = board.ink()
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    out = []
    boxes = np.concatenate([ink.rectangles, black_squares(board, ink)])
    turn = np.linspace(0.0, 2.0 * np.pi, CIRCLE_CORNERS, endpoint=False)
    round_ = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    for flat in (
        boxes[:, None, :2] + corners * boxes[:, None, 2:],
        ink.circles[:, None, :2] + round_ * ink.circles[:, None, 2:],
    ):
        points = np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)
        pixels, valid = camera.project(cam_from_board.apply(points))
        out += list(pixels[valid.all(axis=1)])
    return out


def _path(pixels: Pixels) -> str:
    return svg.line(pixels[np.isfinite(pixels).all(axis=1)])


def plan_facts(plan: Plan, found: Sequence[Table] = ()) -> PageFacts:
    """Return the facts of a plan; `found` are tables of further improvements."""
    headline = f"{plan_lead(plan)}."
    return PageFacts(
        headline=headline[0].upper() + headline[1:],
        sentences=tuple(plan_words(plan)),
        tables=(*found, plan_table(plan)),
    )


def plan_lead(plan: Plan) -> str:
    """Return in words the error of the goal now, if finite, and after the plan."""
    now = f"{plan.error:.3g} {plan.goal.unit} now, " if np.isfinite(plan.error) else ""
    unit = "" if now else f" {plan.goal.unit}"
    return f"{plan.goal.what}: {now}{plan.views[-1].error:.3g}{unit} after these images"


def plan_page(
    plan: Plan,
    title: str,
    provenance: Mapping[str, str],
    taken: Pixels | None = None,
    found: Sequence[Table] = (),
    warning: str = "",
) -> str:
    """Return the plan as self-contained HTML, with a `warning` first."""
    facts = plan_facts(plan, found)
    return render(
        "plan.html",
        title=title,
        lead=warning,
        verdict_line={"words": "", "colour": "", "headline": facts.headline},
        views=views_context(plan, taken),
        dots=taken is not None and len(taken) > 0,
        tables=[table_context(table) for table in facts.tables],
        provenance=provenance,
    )


def views_context(plan: Plan, taken: Pixels | None = None) -> list[tuple[str, Any]]:
    """Return words and drawing of each view for the template `views.html`."""
    return [(words, drawing(view_svg(plan, k, taken))) for k, words in enumerate(plan_words(plan))]
