"""Options that name files."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path


class NamesFiles:
    """Base of options (frozen dataclasses): a path that is given as text becomes one, before any work is done."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if isinstance(value, str) and str(field.type).startswith("Path"):
                object.__setattr__(self, field.name, Path(value))
