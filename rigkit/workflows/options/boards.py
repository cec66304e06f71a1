"""Options of `rigkit check` and `rigkit plan`, apart from the others because boards need numpy."""

from dataclasses import dataclass, field
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.measurement_task import Task
from rigkit.core.reach import Reach
from rigkit.workflows.options.base import FrameRule, WrittenFiles

TYPICAL_SIGMA_PX = 0.15


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
    frames : which images of a rig are of one moment (default: by their names; "order": by the sorted lists).
    """

    boards: tuple[Board, ...] = ()
    before: tuple[Path, ...] = ()
    scene: bool = False
    length: Task | None = None
    fix: Path | None = None
    report: Path | None = None
    history: Path | None = None
    temperature_c: float | None = None
    frames: FrameRule | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanOptions(WrittenFiles):
    """What the images are for, where boards can be held, and the page to write.

    Attributes
    ----------
    count : number of images to plan (default: 3; for a lens 12).
    check : plan images for `rigkit check` that reveal changes best, not images that improve the calibration.
    length : a length at a distance that is to be measured well; None: the projection over the image.
    reach : where boards can be held.
    report : write an HTML report.
    """

    count: int | None = None
    check: bool = False
    length: Task | None = None
    reach: Reach = field(default_factory=Reach)
    report: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LensOptions:
    """A lens that nobody has calibrated yet.

    Attributes
    ----------
    hfov_deg : field of view across the width of the image.
    size_px : width and height of the image.
    boards : boards that will be shown.
    model : camera model (default: chosen by the field of view).
    sigma_px : standard deviation of a corner per coordinate, as real boards have it.
    """

    hfov_deg: float
    size_px: tuple[int, int]
    boards: tuple[Board, ...]
    model: str | None = None
    sigma_px: float = TYPICAL_SIGMA_PX
