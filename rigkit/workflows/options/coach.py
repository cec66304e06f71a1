"""Options of `rigkit coach`, apart from the others because guidance needs numpy and the calibration."""

from dataclasses import dataclass
from pathlib import Path

from rigkit.coach.guide import GuideOptions
from rigkit.core.measurement_task import Task
from rigkit.workflows.options.base import NamesFiles


@dataclass(frozen=True, slots=True, kw_only=True)
class CoachOptions(NamesFiles):
    """Where the session goes, what is shown, and where frames come from.

    Attributes
    ----------
    folder : of the session: a new one, or one to continue.
    boards : COLUMNSxROWSxMM, or files of boards.
    guide : what to reach.
    length : a length at a distance that is to be measured as well as `guide.goal_mm` says.
    cameras : number of cameras of the browser, whose frames are taken together.
    watch : use images that another program writes into it; one for each camera of a rig.
    video : choose the best frames of a recording; one for each camera of a rig.
    device : use camera N of this machine; one for each camera of a rig.
    port : port of the page; 0: any that is free.
    lan : serve the page to the local network, unencrypted.
    """

    folder: Path
    boards: tuple[str, ...]
    guide: GuideOptions
    length: Task | None = None
    cameras: int = 1
    watch: tuple[Path, ...] = ()
    video: tuple[Path, ...] = ()
    device: tuple[int, ...] = ()
    port: int = 8137
    lan: bool = False
