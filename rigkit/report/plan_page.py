"""Views to take: drawn into the image as outlines to hold the board into, in words, and as a page."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels
from rigkit.core.tables import Cell, Column, Table
from rigkit.planning.plan import Plan
from rigkit.planning.words import placement
from rigkit.report.render import drawing, render, shown_table

__all__ = ["plan_page", "plan_table", "plan_to_dict", "plan_words", "shown_views", "view_svg"]

VIEW_WIDTH = 320.0
"""Width of a drawn view, in units of the drawing."""
PAPER, SEEN, FRAME = "#e6550d", "#1f4e8c", "#b8c0cc"
MAX_DOTS = 1500
"""More corners taken so far make the drawing black: of more, a part is drawn."""


def plan_words(plan: Plan) -> list[str]:
    """Return one line a view, the error after it last."""
    camera, unit = plan.knowledge.camera, plan.goal.unit
    several = len({v.board.board_id for v in plan.views}) > 1
    lines = []
    for number, view in enumerate(plan.views, start=1):
        which = f" (board '{view.board.board_id}')" if several else ""
        where = str(placement(camera, view.board, view.cam_from_board))
        lines.append(f"{number}. {where}{which}: {view.error:.3g} {unit} then")
    return lines


def plan_to_dict(plan: Plan) -> dict[str, Any]:
    """Return what a program needs to know."""
    return {
        "goal": plan.goal.what,
        "unit": plan.goal.unit,
        "error_now": plan.error,
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
            for view, where in ((v, placement(plan.knowledge.camera, v.board, v.cam_from_board)) for v in plan.views)
        ],
    }


def plan_table(plan: Plan) -> Table:
    """Return the error of the goal after each view."""
    columns = (Column("views more"), Column(plan.goal.what, plan.goal.unit), Column("less than now by", "%", 0))
    errors = [plan.error, *(view.error for view in plan.views)]
    rows = tuple(
        (Cell(str(k)), Cell(float(f"{error:.4g}")), Cell(100.0 * (1.0 - error / plan.error)))
        for k, error in enumerate(errors)
    )
    return Table("plan", "What the views bring", columns, rows)


def view_svg(plan: Plan, index: int, taken: Pixels | None = None) -> str:
    """Draw the board as it should be seen, over the corners (N, 2) that were taken so far."""
    view, camera = plan.views[index], plan.knowledge.camera
    zoom = VIEW_WIDTH / camera.size_px[0]
    height = zoom * camera.size_px[1]
    title = escape(str(placement(camera, view.board, view.cam_from_board)))
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-1 -1 {VIEW_WIDTH + 2:g} {height + 2:.1f}" role="img">'
        f'<title>{title}</title><rect width="{VIEW_WIDTH:g}" height="{height:.1f}" fill="#fbfcfd" stroke="{FRAME}"/>'
    ]
    if taken is not None and len(taken):
        dots = zoom * taken[:: -(-len(taken) // MAX_DOTS)]
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in dots)
        out.append(f'<path d="{path}" stroke="{SEEN}" stroke-opacity="0.35" stroke-width="2" stroke-linecap="round"/>')
    out += [
        f'<path d="{_path(zoom * square)}Z" fill="{PAPER}" fill-opacity="0.75"/>'
        for square in _black_squares(camera, plan, index)
    ]
    outline = placement(camera, view.board, view.cam_from_board).outline_px
    out.append(f'<path d="{_path(zoom * outline)}Z" fill="none" stroke="{PAPER}" stroke-width="2"/></svg>')
    return "".join(out)


def _black_squares(camera: Camera, plan: Plan, index: int) -> list[Pixels]:
    """Return the black squares (4, 2) of a planned view, those that the lens sees whole."""
    view = plan.views[index]
    board = view.board
    row, column = np.mgrid[: board.rows + 1, : board.columns + 1].reshape(2, -1)
    black = (row + column) % 2 == int(not board.first_black)
    first = np.stack([column[black], row[black]], axis=-1) - 1.0
    around = first[:, None] + np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    flat = around * np.array([board.square_x_mm, board.square_y_mm])
    points = np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)
    pixels, valid = camera.project(view.cam_from_board.apply(points))
    return list(pixels[valid.all(axis=1)])


def _path(pixels: Pixels) -> str:
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in seen)


def plan_page(plan: Plan, title: str, lead: str, provenance: Mapping[str, str], taken: Pixels | None = None) -> str:
    """Return the plan as an HTML page that needs no other file."""
    return render(
        "plan.html",
        title=title,
        lead=lead,
        views=shown_views(plan, taken),
        tables=[shown_table(plan_table(plan))],
        provenance=provenance,
    )


def shown_views(plan: Plan, taken: Pixels | None = None) -> list[tuple[str, Any]]:
    """Return words and drawing of each view, as the template `views.html` shows them."""
    return [(words, drawing(view_svg(plan, k, taken))) for k, words in enumerate(plan_words(plan))]
