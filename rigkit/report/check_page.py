"""A check of a calibration in words, as a table and as a page; a register of checks as drift plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from typing import Any

import numpy as np

from rigkit.cameras.compare import grid_pixels
from rigkit.core.arrays import without_nan
from rigkit.core.tables import Cell, Table, cells, columns
from rigkit.io.history_file import HistoryEntry
from rigkit.report import svg
from rigkit.report.facts_page import build_facts_page
from rigkit.report.page_facts import PageFacts
from rigkit.validation.sentinel.judge import ALARM_CHANCE, Change, SentinelCheck
from rigkit.validation.sentinel.power import FOUND, TIMES, Power

DRAWN_WIDTH, DRIFT_HEIGHT, MARGIN = 600.0, 190.0, 56.0
ARROWS = (21, 16)
ARROW_LENGTH = 0.05
"""The largest arrow is as long as this part of the image's width."""
CONTROL_SIGMAS = 3.0
"""Control limits: what one amount of unchanged cameras leaves in one of 370 checks."""
PART_OF = {"focus": "lens", "principal point": "lens", "distortion": "lens", "rotation": "moved", "shift": "moved"}
"""What changes in several ways are made of."""
LINE, LIMIT, ALARM, GRID = "#1f4e8c", "#b3261e", "#b3261e", "#e3e7ee"


@dataclass(frozen=True, slots=True)
class CheckWords:
    """What a check states: the headline, then sentences."""

    headline: str
    sentences: tuple[str, ...]


def check_words(check: SentinelCheck) -> CheckWords:
    """Return what a check states."""
    frames = "1 fresh frame" if check.frames == 1 else f"{check.frames} fresh frames"
    p = f"p = {check.chance:.3g}"
    sentences = [
        f"Fresh points lie {check.rms_px:.3f} px rms from where the calibration has them ({check.corners} points in "
        f"{frames}); {check.expected_px:.3f} px are expected."
    ]
    change = check.change
    if check.holds:
        headline = f"Still holds ({p}, {frames})"
        if change is not None and check.chance < ALARM_CHANCE:
            sentences.append(
                f"More than chance is there, of no importance: {change}; it moves the projection by "
                f"{change.size_px:.3f} px."
            )
    elif check.unexplained or change is None:
        headline = f"Does NOT hold ({p}): nothing that moved explains it"
        sentences.append(
            f"{check.rms_fixed_px:.2f} px rms are left after the best explanation: another camera, lens or image size, "
            "or another board; check what was photographed, and calibrate anew."
        )
    else:
        headline = f"Does NOT hold ({p}): {change}"
        sentences.append(
            f"It moves the projection by {change.size_px:.3f} px rms; after the correction {check.rms_fixed_px:.3f} px "
            f"are left.{_nearest_words(check, change)}"
        )
    if not check.holds and len(check.watched.cameras) > 1:
        sentences.append(
            "Moved since, or never held? Pictures of the time of the calibration tell: where they alarm alike, the "
            "file never fitted these cameras so well; calibrate anew."
        )
    if check.holds and check.powers:
        worst = min(check.powers, key=lambda power: power.chance)
        sentences.append(_could_have_found(worst))
        if worst.chance < FOUND and len(check.watched.cameras) == 1:
            sentences.append("Which pictures would tell most: rigkit plan CALIBRATION --check")
    if change is not None and not check.holds and check.cost_unit != "px":
        sentences.append(f"In the length it makes an error of {check.cost:.3g} {check.cost_unit} rms.")
    return CheckWords(headline, tuple(sentences))


def _nearest_words(check: SentinelCheck, change: Change) -> str:
    """Return what explains most of a change in several ways by itself, "" for other changes."""
    simpler = [
        c
        for c in check.tried
        if c.cause.camera == change.cause.camera and PART_OF.get(c.cause.kind) == change.cause.kind and c.gain > 0.0
    ]
    if not simpler or change.gain <= 0.0:
        return ""
    best = max(simpler, key=lambda c: c.gain)
    return f" {min(best.gain / change.gain, 1.0):.0%} of what is seen is explained by this alone: {best}."


def _could_have_found(power: Power) -> str:
    """Return what the change that is seen worst would have needed."""
    whose = "" if power.camera is None else f" of camera '{power.camera}'"
    size = f"{power.size:g} {power.unit}"
    seen = f"A change of {size} rms over the image" if power.unit == "px" else f"A turn of {size}"
    said = f"{seen} would have been found with chance {power.chance:.2f} ({power.kind}{whose}, what is seen worst"
    if np.isfinite(power.found_from):
        said += f"; {FOUND:.0%} of the time from {power.found_from:.2g} {power.unit} on"
    if power.chance >= FOUND:
        return f"{said})."
    if power.frames is None:
        told = "far from so sure" if power.both is None else "not so sure itself"
        more = "" if power.both is None else f": it takes about {power.both} times as many, in both"
        return f"{said}); more pictures like these alone would not find it, for the calibration is {told}{more}."
    return f"{said}); {power.frames} pictures like these would find it {FOUND:.0%} of the time."


def _frames_needed(power: Power) -> str:
    if power.frames is not None:
        return f"{power.frames}"
    many = f"more than {TIMES[-1]}" if power.both is None else f"{power.both}"
    return f"{many} times as many, in the calibration too"


def power_table(powers: Sequence[Power], title: str = "What these pictures would have found") -> Table:
    """Return how well changes are seen."""
    heads = columns(f"change | of | found with chance .2 | {FOUND:.0%} found from | frames for {FOUND:.0%}")
    rows = tuple(
        cells(
            power.kind if power.camera is None else f"{power.kind} of {power.camera}",
            f"{power.size:g} {power.unit}",
            power.chance,
            f"{power.found_from:.2g} {power.unit}" if np.isfinite(power.found_from) else "not seen",
            _frames_needed(power),
        )
        for power in powers
    )
    none = cells("none can be told from these pictures", "", None, "", "")
    return Table("powers", title, heads, rows or (none,))


def check_table(check: SentinelCheck) -> Table:
    """Return everything that may have happened, each as if it alone had."""
    rows = []
    for change in check.tried:
        amounts = ", ".join(
            f"{a:+.3g} ± {s:.2g} {unit}"
            for a, s, unit in zip(change.amounts, change.sigmas, change.cause.units, strict=True)
        )
        named = check.change is not None and change.cause is check.change.cause
        rows.append(cells(change.cause.words, f"{change.chance:.2g}", Cell(change.gain, best=named), amounts))
    none = cells("nothing can be told from these pictures", "", None, "")
    heads = columns("if this alone happened | chance without it | explains .1 | amount")
    return Table("causes", "What may have happened", heads, tuple(rows) or (none,))


def check_to_dict(check: SentinelCheck) -> dict[str, Any]:
    """Return what a program needs to know."""
    change = check.change
    return {
        "holds": check.holds,
        "chance": check.chance,
        "statement": check_words(check).headline,
        "cause": None if change is None else change.cause.kind,
        "camera": None if change is None else change.cause.camera,
        "amounts": [] if change is None else change.amounts.tolist(),
        "sigmas": [] if change is None else change.sigmas.tolist(),
        "units": [] if change is None else list(change.cause.units),
        "size_px": None if change is None else change.size_px,
        **{name: getattr(check, name) for name in ("cost", "cost_unit", "rms_px", "rms_fixed_px", "expected_px")},
        "powers": [without_nan(asdict(power)) for power in check.powers],
        "page": check_facts(check).to_dict(),
    }


def check_facts(check: SentinelCheck) -> PageFacts:
    """Return what the page of a check says."""
    words = check_words(check)
    return PageFacts(
        headline=words.headline,
        badge="holds" if check.holds else "does not hold",
        passed=check.holds,
        sentences=words.sentences,
        tables=(check_table(check), power_table(check.powers)),
    )


def check_page(check: SentinelCheck, title: str, provenance: Mapping[str, str]) -> str:
    """Return the check as an HTML page that needs no other file."""
    chance = check.holds and check.chance >= ALARM_CHANCE
    moves = "no more than chance; magnified" if chance else "how the best explanation moves what it sees"
    return build_facts_page(
        title,
        check_facts(check),
        provenance,
        drawings=[(f"{name}: {moves}", change_svg(check, c)) for c, name in enumerate(check.watched.names)],
    )


def change_svg(check: SentinelCheck, c: int) -> str:
    """Draw how the best explanation moves the projection of camera `c` of what stays where it is, magnified."""
    before, after = check.watched.cameras[c], check.fixed.cameras[c]
    turn = check.fixed.cam_from_rig[c].rotation @ check.watched.cam_from_rig[c].rotation.T
    pixels = grid_pixels(before.size_px, ARROWS).reshape(-1, 2)
    rays, valid = before.unproject(pixels)
    moved, seen = after.project(rays[valid] @ turn.T)
    start, by = pixels[valid][seen], (moved - pixels[valid])[seen]
    longest = float(np.linalg.norm(by, axis=1).max(initial=0.0))
    zoom = DRAWN_WIDTH / before.size_px[0]
    times = ARROW_LENGTH * before.size_px[0] / longest if longest > 1e-6 else 0.0
    height = zoom * before.size_px[1]
    words = f"{longest:.3g} px at most, drawn {times:.2g} times as long" if times else "nothing moves"
    return (
        svg.opened(words, f"-1 -1 {DRAWN_WIDTH + 2:g} {height + 2:.1f}")
        + f'<rect width="{DRAWN_WIDTH:g}" height="{height:.1f}" fill="{svg.GROUND_COLOUR}" stroke="{svg.RIM_COLOUR}"/>'
        f'<path d="{svg.strokes(zoom * start, zoom * times * by)}" stroke="{LINE}" stroke-width="1.3" fill="none"/>'
        f'<path d="{svg.dots(zoom * start)}" stroke="{LINE}" stroke-width="3" stroke-linecap="round"/>'
        f'</svg><p class="foot">{words}</p>'
    )


def history_facts(entries: Sequence[HistoryEntry]) -> PageFacts:
    """Return what the page of a register says."""
    alarms = sum(not entry.holds for entry in entries)
    told = {0: "none an alarm", 1: "one an alarm"}.get(alarms, f"{alarms} of them alarms")
    count = "one entry" if len(entries) == 1 else f"{len(entries)} entries, {told}"
    first, last = entries[0].date[:10], entries[-1].date[:10]
    lead = f"{count}, of {last}." if first == last else f"{count}, from {first} to {last}."
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
            "Each amount as if it alone had changed since the calibration, with its standard deviation. Dashed: "
            "control limits, three standard deviations of each entry. Red: entries that raised an alarm.",
        ),
        tables=(_history_table(entries),),
    )


def history_page(entries: Sequence[HistoryEntry], title: str, provenance: Mapping[str, str]) -> str:
    """Return the register as a page: of each calibration a drift plot for each thing that may change, then every
    entry."""
    watched = list(dict.fromkeys(entry.watched for entry in entries))
    drawings = []
    for file in watched:
        own = [entry for entry in entries if entry.watched == file]
        whose = f"{file}: " if len(watched) > 1 else ""
        names = dict.fromkeys(name for entry in own for name in entry.amounts)
        drawings += [(f"{whose}{name}", drift_svg(own, name)) for name in names]
    return build_facts_page(title, history_facts(entries), provenance, drawings=drawings)


def drift_svg(entries: Sequence[HistoryEntry], name: str) -> str:
    """Draw one amount over time with its standard deviations, zero (as calibrated), and the control limits."""
    own = [entry for entry in entries if name in entry.amounts]
    days = np.array([entry.moment.timestamp() / 86400.0 for entry in own])
    value, sigma = np.array([entry.amounts[name] for entry in own]).T
    limit = CONTROL_SIGMAS * sigma
    top = 1.1 * max(float(limit.max()), float((np.abs(value) + sigma).max()), np.finfo(float).tiny)
    span = max(float(np.ptp(days)), 1e-9)
    x = MARGIN + (DRAWN_WIDTH - MARGIN - 14.0) * ((days - days[0]) / span if len(own) > 1 else np.full(1, 0.5))
    middle = 0.5 * (DRIFT_HEIGHT - 24.0)
    y = middle * (1.0 - value / top)
    out = [svg.opened(name, f"0 -6 {DRAWN_WIDTH:g} {DRIFT_HEIGHT + 6:g}", size=12)]
    # One picture tells less than three: every entry has its own limits, up to halfway to its neighbours.
    ends = np.concatenate([[MARGIN], 0.5 * (x[1:] + x[:-1]), [DRAWN_WIDTH - 6.0]])
    for side, colour, dash in ((0.0, "#8a94a3", ""), (1.0, LIMIT, "5 4"), (-1.0, LIMIT, "5 4")):
        height = np.repeat(middle * (1.0 - side * limit / top), 2)
        steps = svg.line(np.stack([np.repeat(ends, 2)[1:-1], height], axis=-1))
        out.append(
            f'<path d="{steps}" fill="none" stroke="{colour}" stroke-dasharray="{dash}"/>'
            f"{svg.words(MARGIN - 5, height[0] + 4, f'{side * limit[0]:.2g}', 'end')}"
        )
    out.append(f'<path d="{svg.line(np.stack([x, y], axis=-1))}" fill="none" stroke="{LINE}" stroke-opacity="0.4"/>')
    for a, b, s, entry in zip(x, y, middle * sigma / top, own, strict=True):
        colour = LINE if entry.holds else ALARM
        out.append(
            f'<line x1="{a:.1f}" x2="{a:.1f}" y1="{b - s:.1f}" y2="{b + s:.1f}" stroke="{colour}"/>'
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.4" fill="{colour}">'
            f"<title>{escape(_of(entry, name))}</title></circle>"
        )
    dates = [(x[0], own[0], "start"), (x[-1], own[-1], "end")]
    for a, entry, anchor in dates if len(own) > 1 else [(x[0], own[0], "middle")]:
        out.append(svg.words(a, DRIFT_HEIGHT - 6, entry.date[:10], anchor))
    return "".join([*out, "</svg>"])


def _of(entry: HistoryEntry, name: str) -> str:
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
