"""The register of a calibration over months (JSON lines, schema "rigkit.history/1"): every check and recalibration with
its date and the estimated changes. Entries are only appended."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rigkit.core.errors import InputError, printable
from rigkit.core.printing import brief
from rigkit.io.disk.json_reader import integer, parse_json, real
from rigkit.io.disk.reading import MAX_NUMBER, read_text
from rigkit.io.disk.writing import ensure_writable
from rigkit.validation.monitoring.verdict import CalibrationCheck

HISTORY_SCHEMA = "rigkit.history/1"
ABSOLUTE_ZERO_C = -273.15


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HistoryEntry:
    """One check or recalibration.

    Attributes
    ----------
    date : UTC, ISO 8601.
    kind : "check", or "calibration" for a new calibration.
    source : the file that was checked, relative to the register's folder.
    reference : for a new calibration, the old one that it is compared with; else "".
    digest : SHA-256 of the file that the amounts refer to, at that time; "" in older registers.
    baseline : SHA-256 of the earlier pictures that the amounts refer to; "" if they refer to the file itself.
    holds, chance, verdict : whether the calibration holds, the p-value, and the verdict in words.
    frames : number of frames.
    rms_px : reprojection error of the new corners, rms.
    temperature_c : temperature, if noted.
    amounts : by cause and unit, such as "focus, %": value and standard deviation if this alone had changed.
    """

    date: str
    kind: str
    source: str
    holds: bool
    chance: float
    verdict: str
    frames: int
    rms_px: float
    reference: str = ""
    digest: str = ""
    baseline: str = ""
    temperature_c: float | None = None
    amounts: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    __repr__ = brief

    @property
    def moment(self) -> datetime:
        """The date; UTC if it has no time zone."""
        moment = datetime.fromisoformat(self.date)
        return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)

    @property
    def watched(self) -> str:
        """The file that the amounts refer to."""
        return self.reference or self.source

    @property
    def report_of(self) -> str:
        """What the amounts refer to: the file, or the file corrected by earlier pictures."""
        return f"{self.watched} since pictures {self.baseline[:8]}" if self.baseline else self.watched

    @classmethod
    def of_check(
        cls,
        check: CalibrationCheck,
        source: Path,
        *,
        reference: Path | None = None,
        digest: str = "",
        baseline: str = "",
        temperature_c: float | None = None,
        now: datetime | None = None,
    ) -> HistoryEntry:
        """Return the entry of a check made `now`; with `reference`, of the new calibration `source`.

        `digest` is the SHA-256 of the file that the changes refer to.
        """
        amounts: dict[str, tuple[float, float]] = {}
        for change in check.tried:
            what = change.hypothesis
            # Flipped pictures show no change of the camera.
            if what.kind in ("lens", "moved") or check.flipped:
                continue
            several = len(change.amounts) > 1
            for k, (amount, sigma, unit) in enumerate(zip(change.amounts, change.sigmas, what.units, strict=True)):
                whose = "" if what.camera is None else f" of {what.camera}"
                amounts[f"{what.kind}{whose}{f' {k + 1}' if several else ''}, {unit}"] = (float(amount), float(sigma))
        moment = now or datetime.now(UTC)
        return cls(
            date=moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            kind="check" if reference is None else "calibration",
            source=source.as_posix(),
            reference="" if reference is None else reference.as_posix(),
            digest=digest,
            baseline=baseline,
            holds=check.holds,
            chance=check.chance,
            verdict=_verdict(check),
            frames=check.frames,
            rms_px=check.rms_px,
            temperature_c=temperature_c,
            amounts=amounts,
        )


def _verdict(check: CalibrationCheck) -> str:
    if check.holds:
        return "holds"
    if check.flipped:
        return f"the images seem {check.flipped}; undoing that, it holds"
    return "no change of the camera or rig explains it" if check.unexplained else str(check.change)


@dataclass(frozen=True, eq=False, slots=True)
class Edition:
    """One content of a calibration's file.

    Attributes
    ----------
    watched : the file.
    digest : SHA-256 of its content; "" if unknown.
    entries : the entries that refer to it, by date.
    several : whether the file had several contents.
    """

    watched: str
    digest: str
    entries: tuple[HistoryEntry, ...]
    several: bool

    @property
    def name(self) -> str:
        """The file, with the date of its first entry if it had several contents."""
        return f"{self.watched} as of {self.entries[0].date[:16].replace('T', ' ')}" if self.several else self.watched


def editions(entries: Iterable[HistoryEntry]) -> tuple[Edition, ...]:
    """Return the editions of the files that entries (by date) refer to.

    An overwritten file is a new edition, and so is a file corrected by earlier pictures. Entries without a digest refer
    to the edition before them, or else to the first one.
    """
    found: dict[tuple[str, str], list[HistoryEntry]] = {}
    latest: dict[str, str] = {}
    for entry in entries:
        whose = entry.report_of
        before = latest.get(whose, "")
        now = latest[whose] = entry.digest or before
        if before == "" and (whose, "") in found:
            found[whose, now] = found.pop((whose, ""))
        found.setdefault((whose, now), []).append(entry)
    files = [watched for watched, _ in found]
    return tuple(
        Edition(watched, digest, tuple(own), files.count(watched) > 1) for (watched, digest), own in found.items()
    )


def path_from_register(register: Path, source: Path) -> Path:
    """Return the path of `source` relative to the folder of a register, so that both can be moved together."""
    try:
        return Path(os.path.relpath(source.resolve(), register.resolve().parent))
    except ValueError:
        # On another drive.
        return source.resolve()


def ensure_register(path: Path, inputs: Iterable[Path] = (), temperature_c: float | None = None) -> None:
    """Raise InputError if no entry can be added to the register at `path`; to be called before the work.

    Refused are one of the `inputs`, a file that is no register, and an impossible temperature.
    """
    if temperature_c is not None and not ABSOLUTE_ZERO_C <= temperature_c <= MAX_NUMBER:
        raise InputError(f"temperature {temperature_c:g}: give degrees Celsius")
    if path.exists():
        if path.resolve() in {other.resolve() for other in inputs}:
            raise InputError(f"cannot add to '{path}': this command reads it; give another name for the register")
        load_history(path)
        if not os.access(path, os.W_OK):
            raise InputError(f"cannot add to '{path}': no permission; choose another register")
    else:
        ensure_writable(path, inputs=inputs)


def add_entry(path: Path, entry: HistoryEntry) -> None:
    """Append an entry to the register at `path`, which is created if missing; safe with concurrent writers.

    Raises InputError if it cannot be written; no partial entry is left.
    """
    line = json.dumps({"schema": HISTORY_SCHEMA, **asdict(entry)}, allow_nan=False).encode() + b"\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            before = os.fstat(handle).st_size
            if before and os.pread(handle, 1, before - 1) != b"\n":
                line = b"\n" + line
            if os.write(handle, line) < len(line):
                os.ftruncate(handle, before)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise InputError(f"cannot add to '{path}': {error.strerror}; nothing was added") from error


def load_history(path: str | Path) -> tuple[HistoryEntry, ...]:
    """Return the entries of a register; raises InputError, with the line, for another or a damaged file."""
    entries = []
    for number, line in enumerate(read_text(path, "register").splitlines(), start=1):
        if line.strip():
            try:
                entries.append(_entry(parse_json(line)))
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                words = printable(str(error))[:120]
                raise InputError(
                    f"register '{path}', line {number}: no entry of {HISTORY_SCHEMA} ({words}); correct or remove that "
                    "line, or give a file that `rigkit check --register` wrote"
                ) from error
    if not entries:
        raise InputError(f"register '{path}': nothing in it; `rigkit check --register` adds to it")
    return tuple(entries)


def _entry(data: Any) -> HistoryEntry:
    if not isinstance(data, dict) or data.pop("schema", None) != HISTORY_SCHEMA:
        raise ValueError("it states another schema")
    temperature, chance, holds = data.pop("temperature_c"), real(data.pop("chance")), data.pop("holds")
    if not (0.0 <= chance <= 1.0 and isinstance(holds, bool)):
        raise ValueError("chance is from 0 to 1, holds true or false")
    texts = {name: data.pop(name) for name in ("date", "kind", "source", "verdict")}
    texts |= {name: data.pop(name, "") for name in ("reference", "digest", "baseline")}
    if not all(isinstance(text, str) for text in texts.values()):
        raise ValueError("date, kind, source, reference, digest, baseline and verdict are words")
    if not datetime.fromisoformat(texts["date"]).year > 1:
        raise ValueError("its date is of the year 1")
    frames, rms_px = integer(data.pop("frames")), real(data.pop("rms_px"))
    if frames < 0 or rms_px < 0.0:
        raise ValueError("frames and rms_px are not negative")
    if temperature is not None and real(temperature) < ABSOLUTE_ZERO_C:
        raise ValueError(f"no temperature is {temperature:g} C")
    entry = HistoryEntry(
        holds=holds,
        chance=chance,
        frames=frames,
        rms_px=rms_px,
        temperature_c=None if temperature is None else real(temperature),
        amounts={str(name): (real(a), _sigma(s)) for name, (a, s) in data.pop("amounts").items()},
        **texts,
    )
    if data:
        raise ValueError(f"unknown key {next(iter(data))!r}")
    return entry


def _sigma(value: Any) -> float:
    number = real(value)
    if number < 0.0:
        raise ValueError(f"a standard deviation is {number:g}")
    return number
