"""Rows of the table of truth, and the tables: a long one, and one with a column for each tool."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from rigkit.core.boards import Board
from rigkit.io.manifests.public_set import PublicMeasurement
from rigkit.io.manifests.rig_session import RigSession
from rigkit.io.manifests.session import Session
from rigkit.workflows.calibration.calibrate import (
    RigSessionCalibration,
    SessionCalibration,
    calibrate_rig_session,
    calibrate_session,
)
from rigkit.workflows.fetch import FetchedSet
from rigkit.workflows.inputs.frames import with_frames
from rigkit.workflows.options.cameras import Cache, CalibrateOptions

RIGKIT, OPENCV, MRCAL, COLMAP = "rigkit", "OpenCV", "mrcal", "COLMAP"
TOOLS = (RIGKIT, OPENCV, MRCAL, COLMAP)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One quantity by one tool in one variant; `sigma` is what the tool states, `truth_sigma` what the measurement
    does. `value` is None where the tool fails: `how` says why."""

    set: str
    quantity: str
    unit: str
    tool: str
    variant: str = ""
    value: float | None
    truth: float | None = None
    truth_sigma: float | None = None
    sigma: float | None = None
    how: str = ""

    @property
    def error(self) -> float | None:
        return None if self.truth is None or self.value is None else self.value - self.truth

    @property
    def in_sigmas(self) -> float | None:
        """The error in the sigmas stated by tool and measurement together; None where the tool states none."""
        if self.error is None or self.sigma is None:
            return None
        return abs(self.error) / float(np.hypot(self.sigma, self.truth_sigma or 0.0))


@dataclass(frozen=True, eq=False, slots=True)
class Bench:
    """A capture on this machine, where results go, and rigkit's model (by default "auto", as in its sessions)."""

    found: FetchedSet
    work: Path
    model: str
    most: int | None = None
    """Most images of boards a camera, spread evenly; None: all."""

    @property
    def name(self) -> str:
        return self.found.described.name

    @property
    def board(self) -> Board:
        return self.found.described.boards[0]

    def images(self, pattern: str) -> tuple[Path, ...]:
        """Return the images of boards, at most as many as asked for."""
        found = self.found.files(pattern)
        if self.most is None or len(found) <= self.most:
            return found
        return tuple(found[k] for k in np.linspace(0, len(found) - 1, self.most).astype(int))

    def session(self, pattern: str, camera: str | None = None, shape: str = "auto") -> Session:
        return Session(
            path=self.work / f"{self.name}.toml",
            images=self.images(pattern),
            boards=self.found.described.boards,
            model=self.model,
            degree=None,
            board_shape=shape,
            camera=camera,
        )

    def alone(self, pattern: str, camera: str | None = None) -> SessionCalibration:
        output = self.work / f"{self.name}-{camera or 'camera'}.json"
        options = CalibrateOptions(output=output, force=True, cache=Cache.UPDATE)
        return calibrate_session(self.session(pattern, camera), options)

    def rig(self, patterns: Mapping[str, str], shape: str = "auto") -> RigSessionCalibration:
        """Return the rig of cameras {name: pattern of their images}; numbers in the names say what belongs together."""
        sessions = {name: self.session(pattern, name, shape) for name, pattern in patterns.items()}
        rig = RigSession(path=self.work / f"{self.name}.toml", cameras=sessions, frames="number", baselines=())
        ready = with_frames(rig)
        assert isinstance(ready, RigSession)
        return calibrate_rig_session(ready, CalibrateOptions(cache=Cache.UPDATE))

    def measured(self, what: str) -> PublicMeasurement:
        return self.found.described.measurement(what)

    def against(self, what: str, tool: str, value: float, sigma: float | None = None, **more: str) -> Row:
        """Return a row of what somebody measured."""
        known = self.measured(what)
        return Row(
            set=self.name,
            quantity=known.what,
            unit=known.unit,
            tool=tool,
            variant=more.get("variant", ""),
            value=value,
            truth=known.value,
            truth_sigma=known.sigma,
            sigma=sigma,
            how=more.get("how", known.how),
        )

    def row(self, quantity: str, tool: str, value: float | None, unit: str = "px", **more: Any) -> Row:
        """Return a row of what nobody measured."""
        return Row(set=self.name, quantity=quantity, unit=unit, tool=tool, value=value, **more)


def number(value: float | None, unit: str = "px") -> str:
    """Return a number with as many digits as say something, a count (no unit) whole, empty without."""
    if value is None:
        return ""
    if not unit:
        return f"{value:.0f}"
    return f"{value:#.3g}" if abs(value) < 10.0 else f"{value:.2f}"


def long_table(rows: Sequence[Row]) -> str:
    """Return a line for each row."""
    head = ["set", "quantity", "unit", "tool", "value", "stated sigma", "measured", "error", "error / sigmas", "how"]
    lines = ["| " + " | ".join(head) + " |", "|" + ":--|" * len(head)]
    for row in rows:
        measured = number(row.truth, row.unit) + ("" if row.truth_sigma is None else f" ± {number(row.truth_sigma)}")
        tool = row.tool + (f" ({row.variant})" if row.variant else "")
        value = "fails" if row.value is None else number(row.value, row.unit)
        numbers = [value, number(row.sigma), measured, number(row.error, row.unit), number(row.in_sigmas)]
        lines.append("| " + " | ".join([row.set, row.quantity, row.unit, tool, *numbers, row.how]) + " |")
    return "\n".join(lines) + "\n"


def short_table(rows: Sequence[Row]) -> str:
    """Return a line for each quantity with the tools side by side."""
    lines = ["| set | quantity | measured | " + " | ".join(TOOLS) + " |", "|" + ":--|" * (3 + len(TOOLS))]
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.set, row.quantity, row.unit), []).append(row)
    last = ""
    for (name, quantity, unit), own in groups.items():
        truth = own[0].truth
        known = "" if truth is None else number(truth, unit)
        known += "" if own[0].truth_sigma is None else f" ± {number(own[0].truth_sigma)}"
        cells = ["; ".join(_cell(row) for row in own if row.tool == tool) for tool in TOOLS]
        what = quantity + (f", {unit}" if unit else "")
        lines.append("| " + " | ".join([name if name != last else "", what, known, *cells]) + " |")
        last = name
    return "\n".join(lines) + "\n"


def _cell(row: Row) -> str:
    value = "fails" if row.value is None else number(row.value, row.unit)
    sigma = "" if row.sigma is None else f" ± {number(row.sigma)}"
    return value + sigma + (f" ({row.variant})" if row.variant else "")


def as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    return [asdict(row) | {"error": row.error, "in_sigmas": row.in_sigmas} for row in rows]


def merged(path: Path, rows: Sequence[Row], order: Sequence[str]) -> list[Row]:
    """Return the rows with those that a file has of other sets, in the order of the sets."""
    new = {row.set for row in rows}
    names = [field.name for field in fields(Row)]
    known = json.loads(path.read_text()) if path.is_file() else []
    kept = [Row(**{name: one[name] for name in names}) for one in known]
    return sorted([*rows, *(row for row in kept if row.set not in new)], key=lambda row: order.index(row.set))


def with_table(page: str, table: str) -> str:
    """Return the page with the table in place of the one between its marks."""
    begin, end = "<!-- table: begin -->\n", "<!-- table: end -->"
    return re.sub(re.escape(begin) + ".*?" + re.escape(end), lambda _: begin + table + end, page, flags=re.DOTALL)
