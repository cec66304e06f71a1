"""What `rigkit calibrate` says of the frames so far. It takes seconds: another process finds it, and the page goes on.

A quick calibration takes a lens for one of two models and a board for bowed. All of `calibrate` tries every model and
shape of board on frames held out, and counts in its sigmas that another may be the right one. Only that is what the
session will come to, so only that may say that there are frames enough.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

from rigkit.calibration.calibrate import FOLDS, calibrate_together
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.choosing.begun import BegunCalibration, begin
from rigkit.calibration.choosing.models_tried import Request
from rigkit.calibration.result import Calibration
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.processes import Here
from rigkit.core.progress import silent
from rigkit.planning.information import Knowledge

STEADY = 0.15
"""By this part of itself the held-out error may differ from that of fewer frames. One that comes to nine others and is
predicted 15 % worse in rms than they are together has residuals twice as large as theirs."""


class WithHeldOut(Protocol):
    """What was calibrated with frames held out."""

    @property
    def heldout_rms_px(self) -> float | None: ...


Found = TypeVar("Found", bound=WithHeldOut)


@dataclass(frozen=True, eq=False, slots=True)
class WholeCalibration:
    """A calibration, what is known by it, for what is to be taken next, how sure it says that the lens is, and what its
    rig need not find again."""

    calibration: Calibration
    knowledge: Knowledge
    stated: UncertainCamera
    begun: BegunCalibration | None = None

    @property
    def heldout_rms_px(self) -> float | None:
        return self.calibration.heldout_rms_px


def whole_calibration(views: Sequence[BoardView], size_px: tuple[int, int]) -> WholeCalibration | None:
    """Return what `calibrate` makes of frames, each of which is an image; None where they do not determine the lens."""
    named = [replace(view, image=f"{k:04d}") for k, view in enumerate(views)]
    request = Request(
        size_px=size_px, model="auto", degree=None, board="auto", folds=FOLDS, progress=silent, pupil="auto"
    )
    try:
        begun = begin("", named, request)
        (found,) = calibrate_together([("", named, request)], known=[begun])
        return WholeCalibration(found, Knowledge.beyond_model(found), uncertain_camera(found), begun)
    except (InputError, DegenerateError):
        return None


class WholeCalibrations(Generic[Found]):
    """Calibrations of the first frames of a capture, one at a time, by `calibrated`, which gets the frames and what
    belongs to them, in another process. `latest` is that of most frames, of which there are `count`."""

    def __init__(self, executor: Executor, calibrated: Callable[..., Found | None]) -> None:
        self.latest: Found | None = None
        self.count = 0
        self._executor, self._calibrated = executor, calibrated
        self._heldout_rms_px: dict[int, float | None] = {}
        self._asked: tuple[int, Future[Found | None]] | None = None

    def go_on(self, frames: Sequence[Any], *given: object) -> bool:
        """Take what has been calibrated meanwhile, and have calibrated what has come; say whether there is news."""
        news = False
        while True:
            # A session that goes on has no held-out error of fewer frames to compare with.
            self.ask(frames if self.is_new(frames) else frames[:-1], *given)
            if not self.arrived():
                return news
            news = True

    def is_new(self, frames: Sequence[Any]) -> bool:
        """Say whether so many frames have not been calibrated."""
        return len(frames) not in self._heldout_rms_px

    def ask(self, frames: Sequence[Any], *given: object) -> None:
        """Have frames calibrated, if that is not known, and nothing else is under way."""
        if self._asked is not None or not self.is_new(frames):
            return
        try:
            future = self._executor.submit(self._calibrated, frames, *given)
        except BrokenProcessPool:
            self._executor = Here()
            future = self._executor.submit(self._calibrated, frames, *given)
        self._asked = len(frames), future

    def arrived(self) -> bool:
        """Say whether there is a new one."""
        if self._asked is None or not self._asked[1].done():
            return False
        (count, future), self._asked = self._asked, None
        try:
            found = future.result()
        except (BrokenProcessPool, CancelledError):
            # Without its process the page stands still for a moment, but the capture goes on.
            self._executor = Here()
            return False
        self._heldout_rms_px[count] = None if found is None else found.heldout_rms_px
        if found is None or count < self.count:
            return False
        self.latest, self.count = found, count
        return True

    def steady(self, count: int) -> bool | None:
        """Say whether the held-out error of so many frames is that of fewer; None: nobody knows yet."""
        before = max((n for n in self._heldout_rms_px if n < count), default=None)
        if before is None or count not in self._heldout_rms_px:
            return None
        now, then = self._heldout_rms_px[count], self._heldout_rms_px[before]
        return self.count == count and now is not None and then is not None and abs(now - then) <= STEADY * then
