"""Options of `rigkit check`, apart from the others because boards need numpy."""

from dataclasses import dataclass
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.measurement_task import Task
from rigkit.workflows.options.base import WrittenFiles


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckOptions(WrittenFiles):
    """What the images show, which errors matter, and the files to write.

    Attributes
    ----------
    boards : boards that may be in the images; (): those of the calibration.
    before : reference images of when it held: report changes since then only.
    scene : without a board: match features of any textured scene (rigs).
    length : a length at a distance: the effect of a change is stated for it, in mm.
    fix : if it does not hold: write the corrected calibration, with the smallest change that explains the images.
    report : write an HTML report.
    history : append the check to this register (see rigkit history).
    temperature_c : temperature during the capture, for the register.
    """

    boards: tuple[Board, ...] = ()
    before: tuple[Path, ...] = ()
    scene: bool = False
    length: Task | None = None
    fix: Path | None = None
    report: Path | None = None
    history: Path | None = None
    temperature_c: float | None = None
