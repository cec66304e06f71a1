"""A check of a calibration as facts, tables, and HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.moving_pupil import far_camera
from rigkit.core.arrays import without_nan
from rigkit.core.printing import counted, probability_words
from rigkit.core.tables import Cell, Table, cells, columns
from rigkit.planning.goal import px_words
from rigkit.report import svg
from rigkit.report.pages.page_facts import PageFacts, build_facts_page
from rigkit.report.svg import DRAWN_WIDTH, INK
from rigkit.validation.monitoring.power import FOUND, TIMES, Power
from rigkit.validation.monitoring.verdict import ALARM_CHANCE, ALARM_PX, Baseline, CalibrationCheck, Change

ARROWS = (21, 16)
ARROW_LENGTH = 0.05
"""Drawn length of the largest arrow, as a fraction of the image's width."""
LIKELY_SEEN = 0.5
"""Pictures with a smaller chance to detect a change do not prove that there was none."""
PART_OF = {"focus": "lens", "principal point": "lens", "distortion": "lens", "rotation": "moved", "shift": "moved"}
"""Kinds of changes that are parts of a combined kind."""


def check_facts(check: CalibrationCheck) -> PageFacts:
    """Return the facts of a check."""
    frames = counted(check.frames, "new frame")
    p = f"p = {check.chance:.3g}"
    # A change may show in the pattern of errors that are no larger than expected, as the calibration is so uncertain.
    compared = check.holds or check.rms_px > check.expected_px
    sentences = [
        f"Reprojection error of the new images: {check.rms_px:.3f} px rms ({check.corners} points in {frames})"
        + (f"; {check.expected_px:.3f} px are expected." if compared else ".")
    ]
    sentences += _since_words(check.baseline)
    change = check.change
    if check.holds:
        little = min((power.chance for power in check.powers), default=0.0) < LIKELY_SEEN
        holds = "Nothing changed since" if check.baseline is not None else "Still holds"
        headline = f"{holds}{', as far as these images show' if little else ''} ({p}, {frames})"
        if change is not None and check.chance < ALARM_CHANCE:
            sentences.append(
                f"A change is significant, but negligible: {change}; it moves the projection by {change.size_px:.3f} "
                "px."
            )
    elif check.flipped:
        headline = f"Does NOT hold for the images as they are ({p}): they seem {check.flipped}; undoing that, it holds"
        sentences.append(
            "Use the files as the camera wrote them: a viewer, an EXIF tag or a setting of the camera flips images."
            + ("" if check.unexplained or change is None else f" The alternative explanation: {change}.")
        )
    elif check.unexplained or change is None:
        headline = f"Does NOT hold ({p}): no change of the camera or rig explains it"
        sentences.append(
            f"{check.rms_fixed_px:.2f} px rms remain after the best correction: another camera, lens, image size or "
            "board? Check what was photographed, and calibrate again."
        )
    else:
        # The amounts of a combined change are not named: only its effect is meaningful.
        what = change.hypothesis.words if change.hypothesis.kind == "lens" else change
        message = "Changed since" if check.baseline is not None else "Does NOT hold"
        headline = f"{message} ({p}): {what}; {_cost_words(check, change)}"
        caveat = "" if change.size_px >= ALARM_PX else f" (up to {change.max_px:.2f} px: poorly determined)"
        sentences.append(
            f"It moves the projection by {change.size_px:.3f} px rms{caveat}; after the correction "
            f"{check.rms_fixed_px:.3f} px remain.{_nearest_words(check, change)}"
        )
    if not check.holds and check.baseline is None and check.monitored.is_rig:
        sentences.append(
            "Changed since, or wrong from the start? Compare with images from the time of the calibration: --before."
        )
    if check.holds and check.powers:
        worst = min(check.powers, key=lambda power: power.chance)
        sentences.append(_power_words(worst))
        if worst.chance < FOUND and not check.monitored.is_rig:
            sentences.append("For the images that would reveal most: rigkit plan CALIBRATION --check")
    return PageFacts(
        headline=headline,
        badge="holds" if check.holds else "does not hold",
        passed=check.holds,
        sentences=tuple(sentences),
        tables=(check_table(check), power_table(check.powers)),
    )


def _since_words(then: Baseline | None) -> list[str]:
    """Return a sentence about the earlier frames; [] without them."""
    if then is None:
        return []
    said = [
        f"Reference: {counted(then.frames, 'earlier frame')}, {then.rms_px:.3f} px rms with the calibration as it is, "
        f"{then.rms_corrected_px:.3f} px corrected to them; this correction is not counted as a change."
    ]
    if then.chance < ALARM_CHANCE:
        said.append(
            f"The calibration was inconsistent with the earlier frames already (p = {then.chance:.2g}): make sure that "
            "they are of the same camera, and that nothing had changed by then."
        )
    return said


def _cost_words(check: CalibrationCheck, change: Change) -> str:
    """Return the cost of a change in words: in the measured length, or in the projection."""
    if check.cost_unit != "px":
        return f"an error of {check.cost:.2g} {check.cost_unit} rms in the length"
    c = 0 if change.hypothesis.camera is None else check.monitored.names.index(change.hypothesis.camera)
    return px_words(check.monitored.cameras[c], change.size_px)


def _nearest_words(check: CalibrationCheck, change: Change) -> str:
    """Return the single change that explains most of a combined change, in words; "" for other changes."""
    simpler = [
        c
        for c in check.tried
        if c.hypothesis.camera == change.hypothesis.camera
        and PART_OF.get(c.hypothesis.kind) == change.hypothesis.kind
        and c.gain > 0.0
    ]
    if not simpler or change.gain <= 0.0:
        return ""
    best = max(simpler, key=lambda c: c.gain)
    return f" {min(best.gain / change.gain, 1.0):.0%} of it is explained by this alone: {best}."


def _power_words(power: Power) -> str:
    """Return the chance to detect the least visible change, and what would raise it, in words."""
    whose = "" if power.camera is None else f" of camera '{power.camera}'"
    size = f"{power.size:g} {power.unit}"
    seen = f"A change of {size} rms over the image" if power.unit == "px" else f"A rotation of {size}"
    chance = probability_words(power.chance)
    message = f"{seen} would have been detected with probability {chance} (worst: {power.kind}{whose}"
    if np.isfinite(power.found_from):
        message += f"; {FOUND:.0%} from {power.found_from:.2g} {power.unit} on"
    if power.chance >= FOUND:
        return f"{message})."
    if power.frames is None:
        reason = "far too uncertain" if power.both is None else "too uncertain itself"
        more = "" if power.both is None else f": that needs about {power.both} times as many in both"
        return f"{message}); more images like these alone would not detect it: the calibration is {reason}{more}."
    return f"{message}); {power.frames} images like these would detect it with probability {FOUND:g}."


def _frames_needed(power: Power) -> str:
    if power.frames is not None:
        return f"{power.frames}"
    many = f"more than {TIMES[-1]}" if power.both is None else f"{power.both}"
    return f"{many} times as many, also in the calibration"


def power_table(powers: Sequence[Power], title: str = "Detectable changes") -> Table:
    """Return the table of the chances to detect changes."""
    heads = columns(f"change | size | probability of detection | {FOUND:.0%} detected from | frames for {FOUND:.0%}")
    rows = tuple(
        cells(
            power.kind if power.camera is None else f"{power.kind} of {power.camera}",
            f"{power.size:g} {power.unit}",
            probability_words(power.chance),
            f"{power.found_from:.2g} {power.unit}" if np.isfinite(power.found_from) else "not detectable",
            _frames_needed(power),
        )
        for power in powers
    )
    none = cells("none is detectable in these images", "", None, "", "")
    return Table("powers", title, heads, rows or (none,))


def check_table(check: CalibrationCheck) -> Table:
    """Return the table of possible changes, each as if it alone had happened."""
    rows = []
    for change in check.tried:
        amounts = change.amounts_with_sigmas()
        named = check.change is not None and change.hypothesis is check.change.hypothesis
        rows.append(cells(change.hypothesis.words, f"{change.chance:.2g}", Cell(change.gain, best=named), amounts))
    none = cells("these images determine no change", "", None, "")
    heads = columns("if this alone changed | p-value of no such change | explains .1 | amount")
    note = (
        "Explains: by how much the weighted sum of squared errors falls with this change. Amounts, in this order: of a "
        "lens the focal length, the principal point to the right and down, the distortion at the rim by the third, "
        "fifth and seventh power of the radius; of a mount turns about, then shifts along x, y, z."
    )
    return Table("causes", "Possible changes", heads, tuple(rows) or (none,), note)


def check_to_dict(check: CalibrationCheck) -> dict[str, Any]:
    """Return the check as JSON values."""
    change, facts = check.change, check_facts(check)
    return {
        "holds": check.holds,
        "chance": check.chance,
        "statement": facts.headline,
        "cause": None if change is None else change.hypothesis.kind,
        "camera": None if change is None else change.hypothesis.camera,
        "amounts": [] if change is None else change.amounts.tolist(),
        "sigmas": [] if change is None else change.sigmas.tolist(),
        "units": [] if change is None else list(change.hypothesis.units),
        "size_px": None if change is None else change.size_px,
        **{name: getattr(check, name) for name in ("cost", "cost_unit", "rms_px", "rms_fixed_px", "expected_px")},
        "baseline": None if check.baseline is None else asdict(check.baseline),
        "powers": [without_nan(asdict(power)) for power in check.powers],
        "page": facts.to_dict(),
    }


def check_page(check: CalibrationCheck, title: str, provenance: Mapping[str, str]) -> str:
    """Return the check as self-contained HTML."""
    chance = check.holds and check.chance >= ALARM_CHANCE
    moves = "image displacement by the best explanation" + (", which is not significant" if chance else "")
    return build_facts_page(
        title,
        check_facts(check),
        provenance,
        drawings=[(f"{name}: {moves}", change_svg(check, c)) for c, name in enumerate(check.monitored.names)],
    )


def change_svg(check: CalibrationCheck, c: int) -> str:
    """Draw how the most likely change moves the projection of fixed points in camera `c`, magnified."""
    before, after = far_camera(check.monitored.cameras[c]), far_camera(check.fixed.cameras[c])
    turn = check.fixed.cam_from_rig[c].rotation @ check.monitored.cam_from_rig[c].rotation.T
    pixels = grid_pixels(before.size_px, ARROWS).reshape(-1, 2)
    rays, valid = before.unproject(pixels)
    moved, seen = after.project(rays[valid] @ turn.T)
    start, by = pixels[valid][seen], (moved - pixels[valid])[seen]
    longest = float(np.linalg.norm(by, axis=1).max(initial=0.0))
    zoom = DRAWN_WIDTH / before.size_px[0]
    times = svg.round_down(ARROW_LENGTH * before.size_px[0] / longest) if longest > 1e-6 else 0.0
    words = "nothing moves" if not times else f"{longest:.3g} px at most, drawn "
    words += "" if not times else "to scale" if times == 1.0 else f"{times:g} times as long"
    return (
        svg.image_ground(words, DRAWN_WIDTH, zoom * before.size_px[1])
        + f'<path d="{svg.strokes(zoom * start, zoom * times * by)}" stroke="{INK}" stroke-width="1.3" fill="none"/>'
        f'<path d="{svg.dots(zoom * start)}" stroke="{INK}" stroke-width="3" stroke-linecap="round"/>'
        f'</svg><p class="foot">{words}</p>'
    )
