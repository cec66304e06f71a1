"""Tables as text: Markdown, CSV, LaTeX (booktabs) and JSON."""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, without_nan
from rigkit.core.printing import MAX_DECIMALS
from rigkit.core.tables import Cell, Column, Table
from rigkit.io.disk.reading import is_number

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of formulas in spreadsheets."""

LATEX = {letter: rf"\{letter}" for letter in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "±": r"$\pm$",
    "|": r"\textbar{}",
}


def tables_to_markdown(tables: Sequence[Table]) -> str:
    """Return all tables as Markdown: value ± sigma, the paper's value in brackets, best and failed cells bold."""
    parts = []
    for table in map(without_empty_columns, tables):
        head = [_escape_markdown(column_label(column)) for column in table.columns]
        lines = [
            f"## {_escape_markdown(table.title)}",
            "",
            _markdown_row(head),
            _markdown_row([":--" if left else "--:" for left in text_columns(table)]),
        ]
        for row in table.rows:
            lines.append(_markdown_row(_with_bold(row, table.columns, _escape_markdown, "**{}**")))
        lines += ["", *filter(None, [_escape_markdown(table_notes(table))])]
        parts.append("\n".join(lines).rstrip() + "\n")
    return "\n".join(parts)


def tables_to_csv(tables: Sequence[Table]) -> str:
    """Return all tables as CSV, each after a line "# title", at full precision, with units in the head.

    Sigmas and the paper's values have separate columns.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    for i, table in enumerate(tables):
        if i:
            out.write("\n")
        out.write(f"# {_one_line(table.title)}\n")
        extra = [_extra_columns(table, j) for j in range(len(table.columns))]
        head: list[str] = []
        for column, (with_sigma, with_paper) in zip(table.columns, extra, strict=True):
            unit = f" [{column.unit}]" if column.unit else ""
            head.append(column.label + unit)
            head += [f"{column.label} sigma{unit}"] if with_sigma else []
            head += [f"{column.label} paper{unit}"] if with_paper else []
        writer.writerow([_csv_text(label) for label in head])
        for row in table.rows:
            cells: list[str] = []
            for cell, (with_sigma, with_paper) in zip(row, extra, strict=True):
                cells.append(_csv_value(cell.value))
                cells += [_csv_value(cell.sigma)] if with_sigma else []
                cells += [cell.paper or ""] if with_paper else []
            writer.writerow(cells)
    return out.getvalue()


def tables_to_latex(tables: Sequence[Table]) -> str:
    r"""Return all tables as LaTeX floats that need \usepackage{booktabs}, and graphicx for wide ones."""
    parts = []
    for table in map(without_empty_columns, tables):
        head = " & ".join(_escape_latex(column_label(column)) for column in table.columns)
        lines = [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{_escape_latex((table.title + '. ' + table_notes(table)).strip())}}}",
            rf"\label{{tab:{table.key}}}",
            r"\resizebox{\textwidth}{!}{%",
            rf"\begin{{tabular}}{{{''.join('l' if left else 'r' for left in text_columns(table))}}}",
            r"\toprule",
            head + r" \\",
            r"\midrule",
        ]
        group = ""
        for row in table.rows:
            kind = str(row[0].value).partition(" error")[0]
            if table.key == "planes" and group and kind != group:
                lines.append(r"\midrule")
            group = kind
            lines.append(" & ".join(_with_bold(row, table.columns, _escape_latex, r"\textbf{{{}}}")) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}}", r"\end{table}"]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def tables_to_json(tables: Sequence[Table]) -> str:
    """Return all tables as a JSON document."""
    return json.dumps({"schema": "rigkit.tables/1", "tables": tables_to_list(tables)}, indent=1, allow_nan=False)


def tables_to_list(tables: Sequence[Table]) -> list[dict[str, Any]]:
    """Return all tables for JSON; a cell is its value, or an object of value, sigma, paper and marks."""
    out = []
    for table in tables:
        rows = [
            {column.label: _cell_dict(cell) for cell, column in zip(row, table.columns, strict=True)}
            for row in table.rows
        ]
        units = {column.label: column.unit for column in table.columns if column.unit}
        out.append({"key": table.key, "title": table.title, "note": table.note, "units": units, "rows": rows})
    return out


def tables_to_text(tables: Sequence[Table]) -> str:
    """Return all tables with aligned columns, for a terminal."""
    parts = []
    for table in map(without_empty_columns, tables):
        grid = [[_one_line(column_label(column)) for column in table.columns]]
        grid += [
            [_one_line(_text(c, column)) for c, column in zip(row, table.columns, strict=True)] for row in table.rows
        ]
        widths = [max(len(line[j]) for line in grid) for j in range(len(table.columns))]
        pad = [str.ljust if left else str.rjust for left in text_columns(table)]
        lines = ["  ".join(p(t, w) for p, t, w in zip(pad, line, widths, strict=True)).rstrip() for line in grid]
        parts.append("\n".join([table.title, *lines, *filter(None, [table_notes(table)])]))
    return "\n\n".join(parts)


TABLE_WRITERS = {"md": tables_to_markdown, "csv": tables_to_csv, "tex": tables_to_latex, "json": tables_to_json}


def table_files(tables: Sequence[Table], stem: str, *endings: str) -> dict[str, str]:
    """Return tables as files (name -> content) of all formats, or of these `endings`."""
    return {f"{stem}.{ending}": TABLE_WRITERS[ending](tables) for ending in endings or TABLE_WRITERS}


def without_empty_columns(table: Table) -> Table:
    """Return a table for people: without columns, such as those of measurements, that are empty in every row. CSV and
    JSON keep these."""
    filled = [
        any(c.paper or without_nan(c.value) not in (None, "") for c in own) for own in zip(*table.rows, strict=True)
    ]
    return replace(
        table,
        columns=tuple(itertools.compress(table.columns, filled)),
        rows=tuple(tuple(itertools.compress(row, filled)) for row in table.rows),
    )


def _cell_dict(cell: Cell) -> Any:
    value = without_nan(cell.value)
    marks = {name: True for name in ("best", "failed") if getattr(cell, name)}
    more: dict[str, Any] = {} if cell.paper is None else {"paper": float(cell.paper)}
    if cell.sigma is not None and np.isfinite(cell.sigma):
        more["sigma"] = cell.sigma
    return {"value": value, **more, **marks} if more or marks else value


def column_label(column: Column) -> str:
    """Return the head of a column, with its unit."""
    return f"{column.label}, {column.unit}" if column.unit else column.label


def _text(cell: Cell, column: Column) -> str:
    """Return the text of a cell."""
    value = without_nan(cell.value)
    if value is None:
        text = "" if cell.paper is None else "-"
    elif isinstance(value, str):
        text = value
    else:
        text = measured_words(value, cell.sigma, column.decimals)
    return text if cell.paper is None else f"{text} ({cell.paper})"


def measured_words(value: float, sigma: float | None, decimals: int) -> str:
    """Return "value ± sigma" with `decimals`, or more if the sigma would be rounded to zero.

    >>> measured_words(120.0031, 0.0042, 2), measured_words(301.0, 0.5, 2), measured_words(301.0, None, 2)
    ('120.003 ± 0.004', '301.00 ± 0.50', '301.00')
    """
    if sigma is None or not np.isfinite(sigma):
        return f"{value:.{decimals}f}"
    while decimals < MAX_DECIMALS and 0.0 < sigma < 0.5 * 10.0**-decimals:
        decimals += 1
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}"


def rounded_words(value: float, sigma: float) -> str:
    """Return "value ± sigma" with two digits of the sigma, small ones with a common power of ten.

    >>> rounded_words(534.0337, 0.3412), rounded_words(-1.23456e-10, 4.2e-13), rounded_words(534.0337, 0.0)
    ('534.03 ± 0.34', '(-1.2346 ± 0.0042)e-10', '534.0337')
    """
    if not (np.isfinite(sigma) and sigma > 0.0 and np.isfinite(value)):
        return f"{value:.9g}"
    largest = max(abs(value), sigma)
    power = 0 if largest >= 1e-3 else int(np.floor(np.log10(largest)))
    value, sigma = value / 10.0**power, sigma / 10.0**power
    decimals = max(1 - int(np.floor(np.log10(sigma))), 0)
    words = f"{value:.{decimals}f} ± {sigma:.{decimals}f}"
    return f"({words})e{power}" if power else words


def rounded_parameters(camera: Camera, sigmas: FloatArray) -> dict[str, str]:
    """Return "value ± sigma" of the camera's parameters by name; `sigmas` (P,)."""
    values, spreads = camera.named(camera.parameters), camera.named(sigmas)
    return {name: rounded_words(value, spreads[name]) for name, value in values.items()}


def text_columns(table: Table) -> list[bool]:
    """Return for each column whether it holds text, which is aligned to the left."""
    return [any(isinstance(row[j].value, str) for row in table.rows) for j in range(len(table.columns))]


def table_notes(table: Table) -> str:
    """Return the text below a table: its note, and the meaning of brackets if there are any."""
    printed = any(cell.paper is not None for row in table.rows for cell in row)
    return " ".join(filter(None, [table.note, "In brackets: the paper's." if printed else ""]))


def _extra_columns(table: Table, j: int) -> tuple[bool, bool]:
    """Return whether column j has sigmas, and values of the paper."""
    cells = [row[j] for row in table.rows]
    return any(cell.sigma is not None for cell in cells), any(cell.paper is not None for cell in cells)


def _csv_value(value: float | str | None) -> str:
    value = without_nan(value)
    if value is None:
        return ""
    if isinstance(value, str):
        return _csv_text(value)
    return str(int(value)) if float(value).is_integer() else repr(float(value))


def _with_bold(row: Sequence[Cell], columns: Sequence[Column], escape: Callable[[str], str], bold: str) -> list[str]:
    """Return the cells as escaped text, the best and failed ones in the form `bold`."""
    texts = [(cell, escape(_text(cell, column))) for cell, column in zip(row, columns, strict=True)]
    return [bold.format(text) if text and (cell.best or cell.failed) else text for cell, text in texts]


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _csv_text(text: str) -> str:
    """Return a text on one line for a spreadsheet; texts that begin like a formula are quoted."""
    text = _one_line(text)
    return f"'{text}" if text.lstrip().startswith(FORMULA) and not is_number(text) else text


def _one_line(text: str) -> str:
    """Return a text with line ends and other control characters replaced by blanks."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _escape_markdown(text: str) -> str:
    """Return a text on one line with Markdown and HTML escaped."""
    return re.sub(r"[\\`*|<>\[\]]", r"\\\g<0>", _one_line(text))


def _escape_latex(text: str) -> str:
    return "".join(LATEX.get(letter, letter) for letter in text)
