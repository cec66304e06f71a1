"""Base classes of the options of workflows."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

FrameRule = Literal["name", "number", "time", "order"]
"""What tells which images of several cameras are of one moment (`rig_session.frames_of_images`)."""


class NamesFiles:
    """Base of option dataclasses: strings become paths in fields of type Path, lists become tuples, and a single value
    need not be in one."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            value, kind = getattr(self, field.name), str(field.type)
            if isinstance(value, str | Path) and "..." in kind:
                value = (value,)
            if isinstance(value, list | tuple):
                value = tuple(Path(one) if isinstance(one, str) and "Path" in kind else one for one in value)
            elif isinstance(value, str) and "Path" in kind:
                value = Path(value)
            object.__setattr__(self, field.name, value)


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenFiles(NamesFiles):
    """Base of options that name files to write.

    Attributes
    ----------
    force : replace existing files; input files are never replaced.
    """

    force: bool = False
