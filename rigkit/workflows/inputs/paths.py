"""Base class of options that hold paths."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path


class NamesFiles:
    """Base of option dataclasses: converts strings in fields of type Path."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if isinstance(value, str) and str(field.type).startswith("Path"):
                object.__setattr__(self, field.name, Path(value))
