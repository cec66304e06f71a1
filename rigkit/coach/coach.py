"""A capture session: looks at frames, takes those that add information, stores them, and resumes earlier sessions."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from enum import Enum
from hashlib import sha256
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.coach.guide import GuideOptions
from rigkit.coach.keeper import Keeper
from rigkit.coach.look import FrameObservation, observe_frame
from rigkit.coach.rig import RigAdvice, RigGuide
from rigkit.core.errors import InputError
from rigkit.io.media.images import announced_sizes, quiet_opencv

MAX_PICTURE_PX = 12000
"""Largest side of an uploaded image."""
LOOK_S = 0.06
"""Where a look takes longer, the next image is reduced: with it ten looks a second are possible."""
MAX_SHRINK = 4
MIN_FRAME_GAIN = 0.05
"""Least gain, relative to that of a board in the outline, for which a frame of a recording is taken."""

Image = NDArray[Any]


def decoded(data: bytes) -> Image:
    """Return the uploaded image (H, W, 3) RGB as on the sensor, without any EXIF rotation; raises InputError for data
    that are no image, or too large a one."""
    # Checked before a decoder allocates memory for them.
    sizes = announced_sizes(data)
    if not sizes or max(max(size_px) for size_px in sizes) > MAX_PICTURE_PX:
        raise InputError(f"coach: not an image of at most {MAX_PICTURE_PX} px a side; send a PNG or JPEG")
    try:
        with quiet_opencv():
            how = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
            picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), how)
    except cv2.error:
        picture = None
    if picture is None:
        raise InputError("coach: the picture is damaged; send it again")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def ignored(_: object) -> None:
    """Do nothing."""


class Take(Enum):
    """Whether a frame is kept: never, where its gain is large enough, or wherever it shows a board."""

    NO = "look"
    IF_USEFUL = "offer"
    YES = "take"


class Coach:
    """A session of one camera, or of several whose frames are taken together. Frames may come from several threads, and
    are processed one at a time."""

    def __init__(
        self,
        options: GuideOptions,
        keeper: Keeper,
        finish: Callable[[], str],
        report: Callable[[str], None] = ignored,
        executor: Executor | None = None,
    ) -> None:
        """Resume with the frames of the keeper. `finish` calibrates the session and returns a summary; `report` gets a
        line for every frame kept, every photo not taken, and the summary; `executor` runs intermediate calibrations, by
        default in the foreground."""
        self.guide, self.keeper = RigGuide(keeper.names, options, executor), keeper
        self._executor = executor
        self.finished: str | None = None
        self._finish, self._report = finish, report
        self._lock = threading.Lock()
        self._last: list[FrameObservation | None] = [None] * len(keeper.names)
        self._shrink = [1] * len(keeper.names)
        self._names: list[str] = []
        self._marks: dict[bytes, str] = {}
        self._called = keeper.names if len(keeper.names) > 1 else (None,)
        self._offered: tuple[Sequence[Image], bool] | None = None
        self._shown: dict[str, Any] = self.guide.state(None, None) | {"looks": 0}
        for name, images in keeper.images():
            seen = [
                observe_frame(image, options.boards, name, camera=camera)
                for image, camera in zip(images, self._called, strict=True)
            ]
            if any(observation.view is not None for observation in seen):
                self._add(name, seen, images)

    def look(
        self,
        images: Sequence[Image],
        *,
        take: Take = Take.NO,
        photo: bool = False,
        source: str = "",
        show: Callable[[Sequence[Image]], None] = ignored,
    ) -> dict[str, Any]:
        """Look at a frame, one image per camera, and return the state for the page: what to do, and the frame's name if
        it was kept. A `photo` is a single image of a board held still; `source` is its file. `show` gets the frame
        together with the state.

        Raises InputError for another number of images or another image size.
        """
        names = self.keeper.names
        if len(images) != len(names):
            raise InputError(f"coach: {len(images)} images of {len(names)} cameras ({', '.join(names)})")
        with self._lock:
            whole = photo or take is Take.YES
            observations = self._observe(images, whole=whole, photo=photo)
            advice = self.guide.advise(observations, photo=photo)
            # When the coach is restarted, a folder is read from its beginning again.
            again = self._marks.get(_mark(images)) if photo else None
            kept = take is Take.YES or (take is Take.IF_USEFUL and advice.take and again is None)
            taken = None
            if kept and any(observation.view is not None for observation in observations):
                if not whole:
                    observations = self._observe(images, whole=True, photo=photo)
                taken = self._keep(images, observations, source)
                advice = self.guide.advise(observations)
            self._last = list(observations)
            self._offered = None if taken else (images, photo)
            show(images)
            self._show(observations, advice, taken=taken)
            if photo and not taken:
                reason = f"it is {again} already" if again else _reason(observations, advice)
                self._report(f"{source or 'photo'}: not taken, as {reason}")
                self.say(f"Not taken, as {reason}. {self._shown['words']}")
            return self._shown

    def _keep(self, images: Sequence[Image], observations: Sequence[FrameObservation], source: str) -> str:
        """Write a frame and add it to the guide; return its name."""
        name = self.keeper.keep(images)
        self._add(name, observations, images)
        self._report(f"{source}: taken as {name}" if source else f"{name} taken")
        return name

    def _add(self, name: str, observations: Sequence[FrameObservation], images: Sequence[Image]) -> None:
        self._names.append(name)
        self._marks[_mark(images)] = name
        self.guide.add(observations)

    def _show(self, observations: Sequence[FrameObservation] | None, advice: RigAdvice | None, **more: Any) -> None:
        looks = self._shown["looks"] + (advice is not None)
        self._shown = self.guide.state(observations, advice) | {"looks": looks, "finished": self.finished, **more}

    def _observe(self, images: Sequence[Image], *, whole: bool, photo: bool) -> list[FrameObservation]:
        """Return what all cameras show; unless `whole`, by quick detection, in a reduced image where that is slow."""
        out, boards = [], self.guide.options.boards
        # A temporary name, so that parts of boards in different frames get different names.
        frame = f"frame {len(self._names)}"
        for c, (image, name, lens) in enumerate(zip(images, self.keeper.names, self.guide.lenses, strict=True)):
            shrink = 1 if whole else self._shrink[c]
            began = time.thread_time()
            observation = observe_frame(
                image, boards, frame, self._last[c], shrink=shrink, quick=not whole, camera=self._called[c]
            )
            if not whole:
                # Detection time is proportional to the image's area.
                spent = (time.thread_time() - began) * shrink**2
                self._shrink[c] = int(np.clip(np.ceil(np.sqrt(spent / LOOK_S)), 1, MAX_SHRINK))
            if lens.size_px not in (None, observation.size_px):
                raise InputError(f"coach: frames of {observation.size_px} px; '{name}' has {lens.size_px} so far")
            out.append(observation.as_photo() if photo else observation)
        return out

    def say(self, words: str) -> None:
        """Show a message on pages between two frames."""
        self._shown = self._shown | {"words": words}

    def state(self) -> dict[str, Any]:
        """Return the latest state: for pages whose frames come from this machine, or are photos."""
        if self._shown.get("waits"):
            with self._lock:
                none = [
                    FrameObservation(size_px=observation.size_px, view=None) for observation in self.guide.frames[-1]
                ]
                advice = self.guide.advise(none)
                if not advice.waits:
                    self._show(none, advice)
        return self._shown | {"finished": self.finished}

    def take_shown(self) -> dict[str, Any]:
        """Keep the latest frame of this machine's cameras, whatever its gain; raises InputError where there is no
        new one."""
        if self._offered is None:
            raise InputError("coach: no new picture to take")
        images, photo = self._offered
        return self.look(images, take=Take.YES, photo=photo)

    def choose(self, frames: Sequence[Sequence[Image]], show: Callable[[Sequence[Image]], None]) -> None:
        """Take the frames with the largest gain from a recording, the best first, and show each, until there are enough
        or none of the rest has a gain."""
        observations: list[list[FrameObservation]] = []
        left = list(range(len(frames)))
        for images in frames:
            self.say(f"Looking closely: {len(observations) + 1} of {len(frames)}")
            observations.append(self._observe(images, whole=True, photo=True))
        while left:
            advice = [self.guide.advise(observations[k]) for k in left]
            if advice[0].enough or max(a.frame_gain for a in advice) < MIN_FRAME_GAIN:
                return
            best = left.pop(int(np.argmax([a.frame_gain for a in advice])))
            with self._lock:
                self._keep(frames[best], observations[best], "")
                show(frames[best])
                chosen = f"Choosing frames: {len(self.guide.frames)} so far"
                self._show(observations[best], self.guide.advise(observations[best]), words=chosen)

    def undo(self) -> dict[str, Any]:
        """Remove the last frame from the session; raises InputError where there is none."""
        with self._lock:
            if not self._names:
                raise InputError("coach: there is no frame to undo")
            self._report(f"{self._names[-1]} set aside")
            dropped = self._names.pop()
            self.keeper.drop(dropped)
            self._marks = {mark: name for mark, name in self._marks.items() if name != dropped}
            frames = self.guide.frames[:-1]
            self.guide = RigGuide(self.keeper.names, self.guide.options, self._executor)
            for observations in frames:
                self.guide.add(observations)
            self._show(None, None)
            return self._shown

    def finish(self, missing: str = "") -> str:
        """Calibrate the session, and return its summary followed by the message `missing`."""
        with self._lock:
            self.finished = self._finish() + missing
            self._report(self.finished)
            return self.finished


def _mark(images: Sequence[Image]) -> bytes:
    """Return a hash of all pixels of a frame."""
    return sha256(b"".join(np.ascontiguousarray(image).tobytes() for image in images)).digest()


def _reason(observations: Sequence[FrameObservation], advice: RigAdvice) -> str:
    """Return why an image is not taken."""
    seeing = [observation for observation in observations if observation.view is not None]
    wrong = next((observation.complaint for observation in seeing if observation.complaint), "")
    if not seeing:
        return "no board is seen"
    if wrong:
        return f"it is not good enough ({wrong})"
    return f"it adds little: {100.0 * max(advice.frame_gain, 0.0):.0f} % of what the place asked for would"
