"""The coach at work: looks at frames, takes those that help, keeps them, and goes on where it was left."""

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
"""Of a picture that a page sends."""
LOOK_S = 0.06
"""A look that takes longer is had at a smaller picture next time: ten of them fit into a second then."""
MAX_SHRINK = 4
MIN_WORTH = 0.05
"""A frame of a recording that brings less than this part of what the outline would is left where it is."""

Image = NDArray[Any]


def decoded(data: bytes) -> Image:
    """Return the picture (H, W, 3) RGB in an upload, as the sensor has it, whatever way up it was held; raises
    InputError where it is none, or too large."""
    # Before a decoder makes room for them.
    sizes = announced_sizes(data)
    if not sizes or max(max(size_px) for size_px in sizes) > MAX_PICTURE_PX:
        raise InputError(f"coach: that is no picture of at most {MAX_PICTURE_PX} px a side; send a PNG or JPEG")
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
    """Show, or tell, nobody."""


class Take(Enum):
    """Whether a frame is kept: not at all, where it is worth it, or wherever a board is in it."""

    NO = "look"
    WORTH = "offer"
    YES = "take"


class Coach:
    """A session of one camera, or of several whose frames are taken together. Frames may come from several threads;
    each is dealt with by itself."""

    def __init__(
        self,
        options: GuideOptions,
        keeper: Keeper,
        finish: Callable[[], str],
        tell: Callable[[str], None] = ignored,
        executor: Executor | None = None,
    ) -> None:
        """Go on with what the keeper has. `finish` calibrates the session and says what came of it; `tell` is given a
        line for every frame that is kept, for every photo that is not, and for what came of it; `executor` calibrates
        meanwhile what there is, by default while all wait."""
        self.guide, self.keeper = RigGuide(keeper.names, options, executor), keeper
        self._executor = executor
        self.finished: str | None = None
        self._finish, self._tell = finish, tell
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
            if any(frame_observation.view is not None for frame_observation in seen):
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
        """Look at a frame, an image a camera, and say what to do, and whether it was kept. A `photo` was taken by
        itself, of a board that was held as still as it shows; `source` is the file that it is from. `show` is given the
        frame together with what is said of it.

        Raises InputError for other cameras' images.
        """
        names = self.keeper.names
        if len(images) != len(names):
            raise InputError(f"coach: {len(images)} images of {len(names)} cameras ({', '.join(names)})")
        with self._lock:
            whole = photo or take is Take.YES
            frame_observations = self._observe(images, whole=whole, photo=photo)
            advice = self.guide.advise(frame_observations, photo=photo)
            # A folder is looked through from its beginning again when the coach is started again.
            again = self._marks.get(_mark(images)) if photo else None
            kept = take is Take.YES or (take is Take.WORTH and advice.take and again is None)
            taken = None
            if kept and any(frame_observation.view is not None for frame_observation in frame_observations):
                if not whole:
                    frame_observations = self._observe(images, whole=True, photo=photo)
                taken = self._keep(images, frame_observations, source)
                advice = self.guide.advise(frame_observations)
            self._last = list(frame_observations)
            self._offered = None if taken else (images, photo)
            show(images)
            self._show(frame_observations, advice, taken=taken)
            if photo and not taken:
                reason = f"it is {again} already" if again else _reason(frame_observations, advice)
                self._tell(f"{source or 'photo'}: not taken, as {reason}")
                self.say(f"Not taken, as {reason}. {self._shown['words']}")
            return self._shown

    def _keep(self, images: Sequence[Image], frame_observations: Sequence[FrameObservation], source: str) -> str:
        """Write a frame and go on with it; return its name."""
        name = self.keeper.keep(images)
        self._add(name, frame_observations, images)
        self._tell(f"{source}: taken as {name}" if source else f"{name} taken")
        return name

    def _add(self, name: str, frame_observations: Sequence[FrameObservation], images: Sequence[Image]) -> None:
        self._names.append(name)
        self._marks[_mark(images)] = name
        self.guide.add(frame_observations)

    def _show(
        self, frame_observations: Sequence[FrameObservation] | None, advice: RigAdvice | None, **more: Any
    ) -> None:
        looks = self._shown["looks"] + (advice is not None)
        self._shown = self.guide.state(frame_observations, advice) | {"looks": looks, "finished": self.finished, **more}

    def _observe(self, images: Sequence[Image], *, whole: bool, photo: bool) -> list[FrameObservation]:
        """Return what all cameras show; what is not `whole` is looked at quickly, and where that is slow, in a
        smaller picture."""
        out, boards = [], self.guide.options.boards
        # Until it is taken: then the part of a board that it shows is not that of the next.
        frame = f"frame {len(self._names)}"
        for c, (image, name, lens) in enumerate(zip(images, self.keeper.names, self.guide.lenses, strict=True)):
            shrink = 1 if whole else self._shrink[c]
            began = time.thread_time()
            frame_observation = observe_frame(
                image, boards, frame, self._last[c], shrink=shrink, quick=not whole, camera=self._called[c]
            )
            if not whole:
                # The work grows with the picture's area.
                spent = (time.thread_time() - began) * shrink**2
                self._shrink[c] = int(np.clip(np.ceil(np.sqrt(spent / LOOK_S)), 1, MAX_SHRINK))
            if lens.size_px not in (None, frame_observation.size_px):
                raise InputError(f"coach: frames of {frame_observation.size_px} px; '{name}' has {lens.size_px} so far")
            out.append(frame_observation.as_photo() if photo else frame_observation)
        return out

    def say(self, words: str) -> None:
        """Tell pages something between two frames."""
        self._shown = self._shown | {"words": words}

    def state(self) -> dict[str, Any]:
        """Return what was said last: for pages whose frames come from this machine, or are photos."""
        if self._shown.get("waits"):
            with self._lock:
                none = [
                    FrameObservation(size_px=frame_observation.size_px, view=None)
                    for frame_observation in self.guide.frames[-1]
                ]
                advice = self.guide.advise(none)
                if not advice.waits:
                    self._show(none, advice)
        return self._shown | {"finished": self.finished}

    def take_shown(self) -> dict[str, Any]:
        """Keep the frame that came from this machine last, whatever it is worth; raises InputError where there is no
        new one."""
        if self._offered is None:
            raise InputError("coach: no new picture to take")
        images, photo = self._offered
        return self.look(images, take=Take.YES, photo=photo)

    def choose(self, frames: Sequence[Sequence[Image]], show: Callable[[Sequence[Image]], None]) -> None:
        """Take the frames that help most out of a recording, the best first, each of which is shown, until there are
        enough or none that is left helps."""
        frame_observations: list[list[FrameObservation]] = []
        left = list(range(len(frames)))
        for images in frames:
            self.say(f"Looking closely: {len(frame_observations) + 1} of {len(frames)}")
            frame_observations.append(self._observe(images, whole=True, photo=True))
        while left:
            advice = [self.guide.advise(frame_observations[k]) for k in left]
            if advice[0].enough or max(a.worth for a in advice) < MIN_WORTH:
                return
            best = left.pop(int(np.argmax([a.worth for a in advice])))
            with self._lock:
                self._keep(frames[best], frame_observations[best], "")
                show(frames[best])
                chosen = f"Choosing frames: {len(self.guide.frames)} so far"
                self._show(frame_observations[best], self.guide.advise(frame_observations[best]), words=chosen)

    def undo(self) -> dict[str, Any]:
        """Set the last frame aside; raises InputError where there is none."""
        with self._lock:
            if not self._names:
                raise InputError("coach: there is no frame to undo")
            self._tell(f"{self._names[-1]} set aside")
            dropped = self._names.pop()
            self.keeper.drop(dropped)
            self._marks = {mark: name for mark, name in self._marks.items() if name != dropped}
            frames = self.guide.frames[:-1]
            self.guide = RigGuide(self.keeper.names, self.guide.options, self._executor)
            for frame_observations in frames:
                self.guide.add(frame_observations)
            self._show(None, None)
            return self._shown

    def finish(self, missing: str = "") -> str:
        """Calibrate the session, and say what came of it, and what is `missing`."""
        with self._lock:
            self.finished = self._finish() + missing
            self._tell(self.finished)
            return self.finished


def _mark(images: Sequence[Image]) -> bytes:
    """Return what tells a frame from others: all its pixels."""
    return sha256(b"".join(np.ascontiguousarray(image).tobytes() for image in images)).digest()


def _reason(frame_observations: Sequence[FrameObservation], advice: RigAdvice) -> str:
    """Return why a picture is not taken."""
    seeing = [frame_observation for frame_observation in frame_observations if frame_observation.view is not None]
    wrong = next((frame_observation.complaint for frame_observation in seeing if frame_observation.complaint), "")
    if not seeing:
        return "no board is seen"
    if wrong:
        return f"it is not good enough ({wrong})"
    return f"it brings little that is new: {100.0 * max(advice.worth, 0.0):.0f} % of what the place asked for would"
