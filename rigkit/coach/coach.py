"""The coach at work: looks at frames, takes those that help, keeps them, and goes on where it was left."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.coach.guide import GuideOptions
from rigkit.coach.keeper import Keeper
from rigkit.coach.look import Glance, glance_at
from rigkit.coach.rig import RigGuide
from rigkit.core.errors import InputError
from rigkit.io.image_size import announced_size
from rigkit.io.images import quiet_opencv

MAX_PICTURE_PX = 12000
"""Of a picture that a page sends."""
LOOK_S = 0.06
"""A look that takes longer is had at a smaller picture next time: ten of them fit into a second then."""
MAX_SHRINK = 4

Image = NDArray[Any]


def decoded(data: bytes) -> Image:
    """Return the picture (H, W, 3) RGB in an upload, as the sensor has it, whatever way up it was held; raises
    InputError where it is none, or too large."""
    # Before a decoder makes room for them.
    size_px = announced_size(data)
    if size_px is None or max(size_px) > MAX_PICTURE_PX:
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


class Coach:
    """A session of one camera, or of several whose frames are taken together. Frames may come from several threads;
    each is dealt with by itself."""

    def __init__(self, options: GuideOptions, keeper: Keeper, finish: Callable[[], str]) -> None:
        """Go on with what the keeper has. `finish` calibrates the session and says what came of it."""
        self.guide, self.keeper = RigGuide(keeper.names, options), keeper
        self.finished: str | None = None
        self._finish = finish
        self._lock = threading.Lock()
        self._last: list[Glance | None] = [None] * len(keeper.names)
        self._shrink = [1] * len(keeper.names)
        self._shown: dict[str, Any] = self.guide.state(None, None)
        for name, images in keeper.images():
            seen = [glance_at(image, options.boards, name) for image in images]
            if any(glance.view is not None for glance in seen):
                self.guide.add(seen)

    def look(self, images: Sequence[Image], *, take: bool = False, photo: bool = False) -> dict[str, Any]:
        """Look at a frame, an image a camera, and say what to do; with `take` keep it where a board is in it, whatever
        it is worth.

        Raises InputError for other cameras' images.
        """
        names = self.keeper.names
        if len(images) != len(names):
            raise InputError(f"coach: {len(images)} images of {len(names)} cameras ({', '.join(names)})")
        with self._lock:
            glances = [self._glance(c, image, full=take or photo) for c, image in enumerate(images)]
            for name, lens, glance in zip(names, self.guide.lenses, glances, strict=True):
                if lens.size_px not in (None, glance.size_px):
                    raise InputError(f"coach: frames of {glance.size_px} px; '{name}' has {lens.size_px} so far")
            if photo:
                glances = [glance.as_photo() for glance in glances]
            self._last = list(glances)
            taken = None
            if take and any(glance.view is not None for glance in glances):
                taken = self.keeper.keep(images)
                self.guide.add(glances)
            advice = self.guide.advise(glances)
            self._shown = self.guide.state(glances, advice) | {"taken": taken, "finished": self.finished}
            return self._shown

    def _glance(self, c: int, image: Image, *, full: bool) -> Glance:
        shrink = 1 if full else self._shrink[c]
        began = time.thread_time()
        glance = glance_at(image, self.guide.options.boards, "frame", self._last[c], shrink=shrink)
        if not full:
            # The work grows with the picture's area.
            whole = (time.thread_time() - began) * shrink**2
            self._shrink[c] = int(np.clip(np.ceil(np.sqrt(whole / LOOK_S)), 1, MAX_SHRINK))
        return glance

    def state(self) -> dict[str, Any]:
        """Return what was said last: for pages whose frames come from this machine."""
        return self._shown | {"finished": self.finished}

    def offer(self, images: Sequence[Image], *, photo: bool = False) -> dict[str, Any]:
        """Look at a frame that is at hand in full: it is taken where it is worth it."""
        state = self.look(images, photo=photo)
        return self.look(images, take=True, photo=photo) if state["take"] else state

    def undo(self) -> dict[str, Any]:
        """Set the last frame aside."""
        with self._lock:
            self.keeper.drop_last()
            frames = self.guide.frames[:-1]
            self.guide = RigGuide(self.keeper.names, self.guide.options)
            for glances in frames:
                self.guide.add(glances)
            return self.guide.state(None, None)

    def finish(self) -> str:
        """Calibrate the session, and say what came of it."""
        with self._lock:
            self.finished = self._finish()
            return self.finished
