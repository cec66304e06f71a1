"""HTML pages from templates; all content is escaped except rigkit's own drawings."""

from __future__ import annotations

import base64
import functools
from collections.abc import Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from rigkit.core.tables import Cell, Column, Table
from rigkit.report.tables import column_label, measured_words, table_notes, text_columns, without_empty_columns

if TYPE_CHECKING:
    from jinja2 import Environment

LONG_WORDS = 60
"""Longer texts in cells are wrapped."""


def render(template: str, **context: Any) -> str:
    """Return `template`, a file of rigkit/report/templates, filled with `context`."""
    return _environment().get_template(template).render(**context)


def data_uri(mime: str, data: bytes) -> str:
    """Return a data URI for an image's `src`; SVG gets the style sheet of drawings."""
    if mime == "image/svg+xml":
        head, sign, rest = data.decode().partition(">")
        data = f"{head}{sign}<style>{asset('drawings.css')}</style>{rest}".encode()
    return f"data:{mime};base64,{base64.b64encode(data).decode()}"


def drawing(svg: str) -> Any:
    """Return SVG of rigkit marked as safe, because its texts are escaped already."""
    from markupsafe import Markup

    return Markup(svg)


def table_context(table: Table, pictures: Sequence[str | None] = ()) -> dict[str, Any]:
    """Return a table for the template `table.html`; `pictures` are image sources of the rows."""
    table = without_empty_columns(table)
    return {
        "title": table.title,
        "head": [(column_label(column), text) for column, text in zip(table.columns, text_columns(table), strict=True)],
        "rows": [
            [_cell_context(c, column) for c, column in zip(row, table.columns, strict=True)] for row in table.rows
        ],
        "pictures": list(pictures) if any(pictures) else [],
        "below": table_notes(table),
    }


def _cell_context(cell: Cell, column: Column) -> dict[str, Any]:
    if isinstance(cell.value, str):
        text = "text words" if len(cell.value) > LONG_WORDS else "text"
        kind = f"{text} fail" if cell.failed else "pass" if cell.value == "pass" else text
        return {"words": cell.value, "kind": kind, "best": False, "paper": None}
    words = "–"
    if cell.value is not None and np.isfinite(cell.value):
        words = measured_words(cell.value, cell.sigma, column.decimals)
    return {"words": words, "kind": "fail" if cell.failed else "", "best": cell.best, "paper": cell.paper}


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("rigkit.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    # "<" in strings of JSON is escaped, too, so that no name can end or open a script element.
    made.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    made.globals["asset"] = asset
    return made


@functools.cache
def asset(name: str) -> Any:
    """Return a style sheet or script of the package, unescaped."""
    return drawing(resources.files("rigkit.report").joinpath(name).read_text(encoding="utf-8"))
