"""The register of a calibration over months (JSON lines, schema "rigkit.history/1"): every check, and every calibration
anew, with the date and what each thing that may change came to. The file only grows."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rigkit.core.errors import InputError
from rigkit.io.calibration_file import damage_named
from rigkit.io.json_reader import real
from rigkit.io.reading import read_bytes
from rigkit.validation.sentinel.judge import SentinelCheck

__all__ = ["HISTORY_SCHEMA", "HistoryEntry", "history_text", "load_history"]

HISTORY_SCHEMA = "rigkit.history/1"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HistoryEntry:
    """One check.

    Attributes
    ----------
    date : when, UTC, ISO 8601.
    kind : "check", or "calibration" for one made anew.
    source : the file that was checked.
    holds, chance, verdict : whether it still held, the p-value, and what was said.
    frames : how many there were.
    rms_px : of the fresh corners.
    temperature_c : where somebody noted it.
    amounts : by cause and unit, such as "focus, %", value and standard deviation, each as if it alone had changed.
    """

    date: str
    kind: str
    source: str
    holds: bool
    chance: float
    verdict: str
    frames: int
    rms_px: float
    temperature_c: float | None = None
    amounts: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of_check(
        cls,
        check: SentinelCheck,
        source: Path,
        *,
        kind: str = "check",
        temperature_c: float | None = None,
        now: datetime | None = None,
    ) -> HistoryEntry:
        """Return the entry of a check made `now`."""
        amounts: dict[str, tuple[float, float]] = {}
        for change in check.tried:
            cause = change.cause
            if cause.kind in ("lens", "moved"):
                continue
            several = len(change.amounts) > 1
            for k, (amount, sigma, unit) in enumerate(zip(change.amounts, change.sigmas, cause.units, strict=True)):
                whose = "" if cause.camera is None else f" of {cause.camera}"
                amounts[f"{cause.kind}{whose}{f' {k + 1}' if several else ''}, {unit}"] = (float(amount), float(sigma))
        moment = now or datetime.now(UTC)
        return cls(
            date=moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            kind=kind,
            source=source.name,
            holds=check.holds,
            chance=check.chance,
            verdict="holds" if check.holds else str(check.change),
            frames=check.frames,
            rms_px=check.rms_px,
            temperature_c=temperature_c,
            amounts=amounts,
        )


def history_text(path: Path, entry: HistoryEntry) -> str:
    """Return the content of the register at `path` with one entry more; raises InputError where it is none."""
    before = ""
    if path.exists():
        load_history(path)
        before = path.read_text(encoding="utf-8")
        before = before if before.endswith("\n") else before + "\n"
    values = {"schema": HISTORY_SCHEMA, **asdict(entry)}
    return before + json.dumps(values, allow_nan=False) + "\n"


def load_history(path: str | Path) -> tuple[HistoryEntry, ...]:
    """Return the entries of a register by their dates; raises InputError for another or a damaged file."""
    lines = read_bytes(Path(path), "register").decode("utf-8", errors="replace").splitlines()
    with damage_named(path):
        entries = [_entry(json.loads(line), path) for line in lines if line.strip()]
    if not entries:
        raise InputError(f"'{path}': nothing in the register; `rigkit check --register` adds to it")
    return tuple(sorted(entries, key=lambda entry: entry.date))


def _entry(data: Any, path: str | Path) -> HistoryEntry:
    if not isinstance(data, dict) or data.pop("schema", None) != HISTORY_SCHEMA:
        raise InputError(f"'{path}': no register of checks ({HISTORY_SCHEMA})")
    amounts = {str(name): (real(a), real(s)) for name, (a, s) in data.pop("amounts").items()}
    datetime.fromisoformat(data["date"])
    if not math.isfinite(real(data["chance"])):
        raise ValueError("chance")
    return HistoryEntry(amounts=amounts, **data)
