"""Base classes of the options of workflows."""

from dataclasses import dataclass, fields
from pathlib import Path


class NamesFiles:
    """Base of option dataclasses: strings become paths in fields of type Path, and a single value need not be in a
    tuple."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if isinstance(value, str) and field.type in (Path, Path | None, "Path", "Path | None"):
                object.__setattr__(self, field.name, Path(value))
            elif isinstance(value, str | Path) and field.type in (tuple[Path, ...], "tuple[Path, ...]"):
                object.__setattr__(self, field.name, (Path(value),))
            elif isinstance(value, str) and field.type in (tuple[str, ...], "tuple[str, ...]"):
                object.__setattr__(self, field.name, (value,))


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenFiles(NamesFiles):
    """Base of options that name files to write.

    Attributes
    ----------
    force : replace existing files; input files are never replaced.
    """

    force: bool = False
