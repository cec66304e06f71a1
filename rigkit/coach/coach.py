"""The coach at work: looks at frames, takes those that help, keeps them, and goes on where it was left."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.coach.guide import CaptureGuide, GuideOptions
from rigkit.coach.keeper import Keeper
from rigkit.coach.look import Glance, glance_at
from rigkit.core.errors import InputError

__all__ = ["Coach", "decoded"]

MAX_PICTURE_PX = 12000
"""Of a picture that a page sends."""


def decoded(data: bytes) -> NDArray[Any]:
    """Return the picture (H, W, 3) RGB in an upload; raises InputError where it is none, or too large."""
    picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR) if data else None
    if picture is None or max(picture.shape[:2]) > MAX_PICTURE_PX:
        raise InputError("coach: that is no picture")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


class Coach:
    """One camera's session. Frames may come from several threads; each is dealt with by itself."""

    def __init__(self, options: GuideOptions, keeper: Keeper, finish: Callable[[], str]) -> None:
        """Go on with what the keeper has. `finish` calibrates the session and says what came of it."""
        self.guide, self.keeper = CaptureGuide(options), keeper
        self.finished: str | None = None
        self._finish = finish
        self._lock = threading.Lock()
        self._last: Glance | None = None
        self._shown: dict[str, Any] = {}
        for name, image in keeper.images():
            seen = glance_at(image, options.boards, name)
            if seen.view is not None:
                self.guide.add(seen.view, seen.size_px)

    def look(self, image: NDArray[Any], *, take: bool = False, photo: bool = False) -> dict[str, Any]:
        """Look at a frame and say what to do; with `take` keep it where a board is in it, whatever it is worth."""
        with self._lock:
            glance = glance_at(image, self.guide.options.boards, "frame", self._last, photo=photo)
            if self.guide.size_px not in (None, glance.size_px):
                raise InputError(f"coach: frames of {glance.size_px} px; this session has {self.guide.size_px}")
            self._last = glance
            taken = None
            if take and glance.view is not None:
                taken = self.keeper.keep(image).name
                self.guide.add(glance.view, glance.size_px)
            advice = self.guide.advise(glance)
            self._shown = self.guide.state(glance, advice) | {"taken": taken, "finished": self.finished}
            return self._shown

    def state(self) -> dict[str, Any]:
        """Return what was said last: for pages whose frames come from this machine."""
        return self._shown | {"finished": self.finished}

    def offer(self, image: NDArray[Any], *, photo: bool = False) -> dict[str, Any]:
        """Look at a frame that is at hand in full: it is taken where it is worth it."""
        state = self.look(image, photo=photo)
        return self.look(image, take=True, photo=photo) if state["take"] else state

    def undo(self) -> dict[str, Any]:
        """Set the last frame aside."""
        with self._lock:
            self.keeper.drop_last()
            views, size_px = self.guide.views[:-1], self.guide.size_px
            self.guide = CaptureGuide(self.guide.options)
            for view in views:
                assert size_px is not None
                self.guide.add(view, size_px)
            return self.guide.state(None, None)

    def finish(self) -> str:
        """Calibrate the session, and say what came of it."""
        with self._lock:
            self.finished = self._finish()
            return self.finished
