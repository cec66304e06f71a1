"""Full calibrations of the frames so far, in another process: they take seconds, during which the page stays live.

A quick calibration assumes one of two lens models, and warped boards. The full `calibrate` compares all models and
shapes of boards by cross-validation, and includes the inadequacy of the model in its covariance. The session will end
with it, so only it decides whether there are enough frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from rigkit.calibration.calibrate import FOLDS, calibrate_together
from rigkit.calibration.certainty.departures import with_own_noise
from rigkit.calibration.certainty.displaced import lens_modes, uncertain_camera
from rigkit.calibration.choosing.candidate_fits import CandidateFits, fit_candidates
from rigkit.calibration.choosing.models_tried import Request
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.result import RigCalibration
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.processes import SerialExecutor
from rigkit.core.progress import silent
from rigkit.planning.information import Knowledge

STEADY = 0.15
"""Largest relative change of the cross-validation error since fewer frames. For a tenth frame to raise the rms of nine
by 15 % when predicted, its residuals must be twice as large as theirs."""


@dataclass(frozen=True, eq=False, slots=True)
class FullCalibration:
    """A full calibration, the knowledge of the camera for planning, the camera with its covariance as stated to users,
    and intermediate results that the rig's calibration reuses."""

    calibration: Calibration
    knowledge: Knowledge
    stated: UncertainCamera
    candidate_fits: CandidateFits | None = None

    @property
    def heldout_rms_px(self) -> float | None:
        return self.calibration.heldout_rms_px


def full_calibration(views: Sequence[BoardView], size_px: tuple[int, int]) -> FullCalibration | None:
    """Return the full calibration from frames, one image each; None where they do not determine the lens."""
    named = [replace(view, image=f"{k:04d}") for k, view in enumerate(views)]
    request = Request(
        size_px=size_px, model="auto", degree=None, board="auto", folds=FOLDS, progress=silent, pupil="auto"
    )
    try:
        candidate_fits = fit_candidates("", named, request)
        (found,) = calibrate_together([("", named, request)], known=[candidate_fits])
        modes = lens_modes(found)
        known = Knowledge.of(with_own_noise(found)).with_model_inadequacy(modes)
        return FullCalibration(found, known, uncertain_camera(found, modes=modes), candidate_fits)
    except (InputError, DegenerateError):
        return None


Found = TypeVar("Found", bound=FullCalibration | RigCalibration)


class FullCalibrations(Generic[Found]):
    """Calibrations of the first frames of a capture, one at a time, in another process, by `calibrated`, called with
    the frames and further arguments. `latest` is that of the most frames, of which there are `count`."""

    def __init__(self, executor: Executor, calibrated: Callable[..., Found | None]) -> None:
        self.latest: Found | None = None
        self.count = 0
        self._executor, self._calibrated = executor, calibrated
        self._heldout_rms_px: dict[int, float | None] = {}
        self._running: tuple[int, Future[Found | None]] | None = None

    def update(self, frames: Sequence[Any], *given: object) -> bool:
        """Use finished calibrations, and start one of new frames; say whether any has finished."""
        news = False
        while True:
            # A resumed session has no error of fewer frames to compare with: these are calibrated too.
            self.start(frames if self.is_unfinished(frames) else frames[:-1], *given)
            if not self.collect():
                return news
            news = True

    def is_unfinished(self, frames: Sequence[Any]) -> bool:
        """Say whether the calibration of this number of frames has not finished."""
        return len(frames) not in self._heldout_rms_px

    def start(self, frames: Sequence[Any], *given: object) -> None:
        """Start a calibration of frames, unless it has finished or another is running."""
        if self._running is not None or not self.is_unfinished(frames):
            return
        try:
            future = self._executor.submit(self._calibrated, frames, *given)
        except BrokenProcessPool:
            self._executor = SerialExecutor()
            future = self._executor.submit(self._calibrated, frames, *given)
        self._running = len(frames), future

    def collect(self) -> bool:
        """Say whether a new one has finished."""
        if self._running is None or not self._running[1].done():
            return False
        (count, future), self._running = self._running, None
        try:
            found = future.result()
        except (BrokenProcessPool, CancelledError):
            # Without the process, calibrations block the page for a moment, but the capture goes on.
            self._executor = SerialExecutor()
            return False
        self._heldout_rms_px[count] = None if found is None else found.heldout_rms_px
        if found is None or count < self.count:
            return False
        self.latest, self.count = found, count
        return True

    def is_steady(self, count: int) -> bool | None:
        """Say whether the error of this number of frames agrees with that of fewer; None where one is missing."""
        before = max((n for n in self._heldout_rms_px if n < count), default=None)
        if before is None or count not in self._heldout_rms_px:
            return None
        now, then = self._heldout_rms_px[count], self._heldout_rms_px[before]
        return self.count == count and now is not None and then is not None and abs(now - then) <= STEADY * then
