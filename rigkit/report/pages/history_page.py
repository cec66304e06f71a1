"""A register of checks over months as a page: drift over time and over temperature, and all entries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.tables import Cell, Table, cells, columns
from rigkit.io.calibrations.history_file import Edition, HistoryEntry, editions
from rigkit.report import svg
from rigkit.report.pages.page_facts import PageFacts, build_facts_page
from rigkit.report.svg import DRAWN_WIDTH, INK, SOFT, WRONG
from rigkit.report.tables import rounded_words
from rigkit.validation.monitoring.drift import HeatDrift, heat_drift
from rigkit.validation.monitoring.verdict import ALARM_CHANCE

DRIFT_HEIGHT, LEFT_MARGIN = 190.0, 56.0
ZERO_HEIGHT = 0.5 * (DRIFT_HEIGHT - 24.0)
LABEL_HEIGHT = 12.0
"""Labels of limits nearer to zero would cover that of zero."""
CONTROL_SIGMAS = 3.0
"""Control limits, which an amount exceeds in one of 370 checks of an unchanged camera if all sigmas hold. Verdicts have
p-values of simulated checks, which also count few frames and what lens models leave out."""


def history_facts(entries: Sequence[HistoryEntry]) -> PageFacts:
    """Return the facts of a register."""
    alarms = sum(not entry.holds for entry in entries)
    labels = {0: "none an alarm", 1: "one an alarm"}.get(alarms, f"{alarms} of them alarms")
    count = "one entry" if len(entries) == 1 else f"{len(entries)} entries, {labels}"
    first, last = entries[0].date[:10], entries[-1].date[:10]
    lead = f"{count}, of {last}." if first == last else f"{count}, from {first} to {last}."
    kept = editions(entries)
    newest = {entry.watched: entry.holds for entry in entries}
    bad = [file for file, holds in newest.items() if not holds]
    if len(newest) == 1:
        headline = f"The last entry {'is an alarm' if bad else 'holds'}"
    else:
        headline = (
            f"The last entry of {' and of '.join(bad)} is an alarm" if bad else "The last entry of each file holds"
        )
    return PageFacts(
        headline=f"{headline}; {lead}",
        badge="does not hold" if bad else "holds",
        passed=not bad,
        sentences=(
            "Each quantity as if it alone had changed since the calibration, with its standard deviation. Dashed: "
            "control limits (three standard deviations of each entry). Red: entries that do not hold; the p-value of "
            "all frames together decides it, so that single amounts may lie beyond their limits.",
            *overwritten(kept),
        ),
        tables=(*_heat_tables(kept), _history_table(entries)),
    )


def overwritten(kept: Sequence[Edition]) -> tuple[str, ...]:
    """Return sentences about calibration files that were overwritten."""
    lines = []
    for watched in dict.fromkeys(edition.watched for edition in kept if edition.several):
        own = [edition for edition in kept if edition.watched == watched]
        since = " and ".join(edition.entries[0].date[:10] for edition in own[1:])
        lines.append(
            f"{watched} is another file since the entry of {since}: amounts are changes of what it held then, and each "
            "is drawn by itself."
        )
    return tuple(lines)


def history_page(entries: Sequence[HistoryEntry], title: str, provenance: Mapping[str, str]) -> str:
    """Return the page of a register, with drift plots of each calibration and amount over time and, if temperatures
    differ, over temperature."""
    kept = editions(entries)
    drawings = []
    for edition in kept:
        whose = f"{edition.name}: " if len(kept) > 1 else ""
        for name in _names(edition):
            drawings.append((f"{whose}{name}", drift_svg(edition.entries, name)))
            heat = _temperature_drift(edition, name)
            if heat is not None:
                own = _entries_by_temperature(edition, name)
                drawings.append((f"{whose}{name}: against temperature", heat_svg(own, name, heat)))
    return build_facts_page(title, history_facts(entries), provenance, drawings=drawings)


def _names(edition: Edition) -> list[str]:
    return list(dict.fromkeys(name for entry in edition.entries for name in entry.amounts))


def _entries_by_temperature(edition: Edition, name: str) -> list[HistoryEntry]:
    """Return the entries with this amount and a temperature, sorted by temperature."""
    own = [entry for entry in edition.entries if name in entry.amounts and entry.temperature_c is not None]
    return sorted(own, key=lambda entry: entry.temperature_c or 0.0)


def _temperature_drift(edition: Edition, name: str) -> HeatDrift | None:
    own = _entries_by_temperature(edition, name)
    if not own:
        return None
    value, sigma = np.array([entry.amounts[name] for entry in own]).T
    return heat_drift(_celsius(own), value, sigma)


def _celsius(entries: Sequence[HistoryEntry]) -> FloatArray:
    return np.array([entry.temperature_c for entry in entries], dtype=np.float64)


def _heat_tables(kept: Sequence[Edition]) -> tuple[Table, ...]:
    """Return the table of drifts with temperature; () without any."""
    rows: list[tuple[Cell, ...]] = []
    for edition in kept:
        for name in _names(edition):
            heat, own = _temperature_drift(edition, name), _entries_by_temperature(edition, name)
            if heat is not None:
                low, high = own[0].temperature_c, own[-1].temperature_c
                what, _, unit = name.rpartition(", ")
                message = f"{rounded_words(heat.per_degree, heat.sigma)} {unit} per °C"
                rows.append(
                    cells(f"{edition.name}: {what}" if len(kept) > 1 else what)
                    + cells(Cell(message, best=heat.chance < ALARM_CHANCE), f"{heat.chance:.2g}")
                    + cells(f"{low:.3g} to {high:.3g}", len(own))
                )
    heads = columns("quantity | per °C | p-value of no effect | from, to [°C] | entries .0")
    return (Table("heat", "Against temperature", heads, tuple(rows)),) if rows else ()


def drift_svg(entries: Sequence[HistoryEntry], name: str) -> str:
    """Draw an amount over time with standard deviations, zero (as calibrated) and control limits."""
    own = [entry for entry in entries if name in entry.amounts]
    days = np.array([entry.moment.timestamp() / 86400.0 for entry in own])
    value, sigma = np.array([entry.amounts[name] for entry in own]).T
    limit = CONTROL_SIGMAS * sigma
    top = _upper_limit(float(limit.max()), value, sigma)
    x = _x_coordinates(days)
    out = [svg.opening_tag(name, f"0 -6 {DRAWN_WIDTH:g} {DRIFT_HEIGHT + 6:g}", size=12)]
    # The limits depend on the number of pictures: every entry has its own, up to halfway to its neighbours.
    ends = np.concatenate([[LEFT_MARGIN], 0.5 * (x[1:] + x[:-1]), [DRAWN_WIDTH - 6.0]])
    for side, colour, dash in ((0.0, SOFT, ""), (1.0, WRONG, "5 4"), (-1.0, WRONG, "5 4")):
        height = np.repeat(ZERO_HEIGHT * (1.0 - side * limit / top), 2)
        steps = svg.line(np.stack([np.repeat(ends, 2)[1:-1], height], axis=-1))
        out.append(f'<path d="{steps}" fill="none" stroke="{colour}" stroke-dasharray="{dash}"/>')
        if side == 0.0 or abs(height[0] - ZERO_HEIGHT) > LABEL_HEIGHT:
            out.append(svg.label(LEFT_MARGIN - 5, height[0] + 4, f"{side * limit[0]:.2g}", "end"))
    y = ZERO_HEIGHT * (1.0 - value / top)
    out.append(f'<path d="{svg.line(np.stack([x, y], axis=-1))}" fill="none" stroke="{INK}" stroke-opacity="0.4"/>')
    of_one_day = own[0].date[:10] == own[-1].date[:10]
    labels = [entry.date[11:16] if of_one_day else entry.date[:10] for entry in own]
    return "".join([*out, *_points(own, name, x, top), *_x_labels(x, labels), "</svg>"])


def heat_svg(entries: Sequence[HistoryEntry], name: str, heat: HeatDrift) -> str:
    """Draw an amount over temperature, with standard deviations and the fitted line; `entries` by temperature."""
    celsius = _celsius(entries)
    value, sigma = np.array([entry.amounts[name] for entry in entries]).T
    top = _upper_limit(0.0, value, sigma)
    x, y = _x_coordinates(celsius), ZERO_HEIGHT * (1.0 - heat.at(celsius) / top)
    out = [svg.opening_tag(f"{name} against temperature", f"0 -6 {DRAWN_WIDTH:g} {DRIFT_HEIGHT + 6:g}", size=12)]
    for amount in (-top / 1.1, 0.0, top / 1.1):
        height = ZERO_HEIGHT * (1.0 - amount / top)
        ends = svg.line([np.array([LEFT_MARGIN, height]), np.array([DRAWN_WIDTH - 6.0, height])])
        stroke = SOFT if amount == 0.0 else svg.RIM_COLOUR
        out.append(
            f'<path d="{ends}" stroke="{stroke}"/>{svg.label(LEFT_MARGIN - 5, height + 4, f"{amount:.2g}", "end")}'
        )
    out.append(f'<path d="{svg.line(np.stack([x, y], axis=-1))}" fill="none" stroke="{INK}" stroke-opacity="0.6"/>')
    labels = [f"{c:.3g} °C" for c in celsius]
    return "".join([*out, *_points(entries, name, x, top), *_x_labels(x, labels), "</svg>"])


def _upper_limit(limit: float, value: FloatArray, sigma: FloatArray) -> float:
    """Return the amount at the upper edge of a drawing."""
    return 1.1 * max(limit, float((np.abs(value) + sigma).max()), np.finfo(float).tiny)


def _x_coordinates(values: FloatArray) -> FloatArray:
    """Return x coordinates of values, from the left to the right of a drawing; a single one in the middle."""
    part = (values - values[0]) / max(float(np.ptp(values)), 1e-9) if len(values) > 1 else np.full(1, 0.5)
    return np.asarray(LEFT_MARGIN + (DRAWN_WIDTH - LEFT_MARGIN - 14.0) * part)


def _x_labels(x: FloatArray, labels: Sequence[str]) -> list[str]:
    """Return the labels below the first and the last point."""
    if len(labels) == 1:
        return [svg.label(x[0], DRIFT_HEIGHT - 6, labels[0], "middle")]
    return [svg.label(x[k], DRIFT_HEIGHT - 6, labels[k], anchor) for k, anchor in ((0, "start"), (-1, "end"))]


def _points(entries: Sequence[HistoryEntry], name: str, x: FloatArray, top: float) -> list[str]:
    """Return the points of entries at `x` with their standard deviations."""
    out = []
    for a, entry in zip(x, entries, strict=True):
        value, sigma = entry.amounts[name]
        b, s, colour = ZERO_HEIGHT * (1.0 - value / top), ZERO_HEIGHT * sigma / top, INK if entry.holds else WRONG
        out.append(
            f'<line x1="{a:.1f}" x2="{a:.1f}" y1="{b - s:.1f}" y2="{b + s:.1f}" stroke="{colour}"/>'
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.4" fill="{colour}">'
            f"<title>{escape(_point_words(entry, name))}</title></circle>"
        )
    return out


def _point_words(entry: HistoryEntry, name: str) -> str:
    value, sigma = entry.amounts[name]
    heat = "" if entry.temperature_c is None else f", {entry.temperature_c:g} °C"
    return f"{entry.date[:16]}{heat}: {value:+.3g} ± {sigma:.2g}; {entry.verdict}"


def _history_table(entries: Sequence[HistoryEntry]) -> Table:
    heads = columns("date | what | frames .0 | rms [px] | p | temperature [°C] .1 | verdict")
    rows = tuple(
        cells(e.date[:16].replace("T", " "), f"{e.kind} of {e.source}", e.frames, e.rms_px, f"{e.chance:.2g}")
        + cells(e.temperature_c, Cell(e.verdict, failed=not e.holds))
        for e in entries
    )
    return Table("entries", "Entries", heads, rows)
