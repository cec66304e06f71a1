"""Guidance for several cameras whose frames are taken together: each lens by its own guide, the mounts by the boards
that two cameras see at once. For one camera it is that camera's guide.

First the lens with the largest error determines the advice, until all have enough frames; then the camera with the
least certain mount; then the calibration of the whole rig from all frames, which alone decides whether it is enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rigkit.calibration.rig.result import RigCalibration
from rigkit.coach.full_calibration import FullCalibrations
from rigkit.coach.full_rig_calibration import RigKnowledge, full_rig_calibration
from rigkit.coach.guide import (
    CHECKING,
    ENOUGH_FRAMES,
    MIN_GAIN_TO_CONTINUE,
    Advice,
    CaptureGuide,
    GuideOptions,
    enough_words,
    min_gain_of,
    posed_view,
)
from rigkit.coach.look import FrameObservation
from rigkit.core.arrays import Pixels
from rigkit.core.errors import DegenerateError
from rigkit.core.processes import SerialExecutor
from rigkit.planning.candidates import board_poses_in_view, outline_mm, placement
from rigkit.planning.goal import RemainingError
from rigkit.planning.information import BoardPoses, SharedViews, median_motion, mount_error_px, mount_information

SHARED_FRAMES = 5
"""With fewer boards seen by two cameras at once, their disagreement cannot be estimated."""
MAX_HELP = 3.0
"""Largest improvement of a lens by the rig over its own calibration (2.6 in ten REAL frames of a pair of 63 degrees).
If a lens needs more, the rig is not calibrated, which takes seconds: the session then ends later."""
TAKING = "Good: taking it"
MAX_MARKS = 1500
"""Most corners drawn."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigAdvice:
    """The coach's advice on the latest frame of all cameras.

    Attributes
    ----------
    lenses : advice of each camera's guide.
    mount_px : error of the mounts; None before it can be estimated.
    frame_gain : gain of the frame, relative to that of a board in the outline.
    enough, waits : whether there are enough frames; whether there is no instruction until that is known.
    advised_camera : index of the camera that the words are about.
    targets : for each camera the outline (K, 2) to hold the board into, or None.
    remaining, gain : after a calibration of the rig, its errors with their requirements, and the relative reduction of
        the worst of them by two more frames.
    """

    lenses: tuple[Advice, ...]
    mount_px: float | None
    words: str = ""
    frame_gain: float = 0.0
    take: bool = False
    enough: bool = False
    waits: bool = False
    advised_camera: int = 0
    targets: tuple[Pixels | None, ...] = ()
    remaining: tuple[RemainingError, ...] = ()
    gain: float | None = None

    @property
    def more_percent(self) -> float | None:
        """Reduction of the error by two more frames."""
        return self.lenses[self.advised_camera].more_percent if self.gain is None else 100.0 * self.gain


class RigGuide:
    """Frames that all cameras took together, and the advice that follows from them."""

    def __init__(self, names: Sequence[str], options: GuideOptions, executor: Executor | None = None) -> None:
        self.names, self.options = tuple(names), options
        # A requirement on what is measured is one on the rig, not on single cameras.
        alone = options if len(names) == 1 else replace(options, goal_mm=None)
        self.lenses = tuple(CaptureGuide(alone, executor) for _ in names)
        self._full = FullCalibrations(executor or SerialExecutor(), full_rig_calibration)
        self._known: RigKnowledge | None = None
        self.frames: list[tuple[FrameObservation, ...]] = []
        self._shared: dict[int, SharedViews | None] = {}
        self._asked: dict[int, tuple[str, list[Pixels | None]]] = {}

    def add(self, observations: Sequence[FrameObservation]) -> None:
        """Add a frame of every camera."""
        self.frames.append(tuple(observations))
        self._shared.clear()
        self._asked.clear()
        for lens, observation in zip(self.lenses, observations, strict=True):
            if observation.view is not None:
                lens.add(observation.view, observation.size_px)

    def advise(self, observations: Sequence[FrameObservation], *, photo: bool = False) -> RigAdvice:
        """Return what to do, and whether to take these frames, or photos."""
        lenses = tuple(
            lens.advise(observation, photo=photo) for lens, observation in zip(self.lenses, observations, strict=True)
        )
        mounts = {c: self._mount_px(c) for c in range(1, len(lenses))}
        open_mounts = [c for c, px in mounts.items() if px is None or px > self.options.goal_px]
        known_px = [px for px in mounts.values() if px is not None]
        mount_px = max(known_px) if mounts and len(known_px) == len(mounts) else None
        advice = RigAdvice(lenses=lenses, mount_px=mount_px, targets=(None,) * len(lenses))
        alone = all(lens.enough for lens in lenses)
        if len(lenses) > 1 and not open_mounts and (alone or self._rig_is_enough(lenses)):
            advice = self._of_rig(advice, observations, photo=photo)
        elif len(lenses) == 1 or not alone:
            advice = self._of_lenses(advice, observations)
        else:
            advised_camera = max(open_mounts, key=lambda c: np.inf if mounts[c] is None else float(mounts[c] or 0.0))
            advice = self._of_mount(replace(advice, advised_camera=advised_camera), observations)
        seeing, min_gain = [g for g in observations if g.view is not None], min_gain_of(photo=photo)
        complaint = next((g.complaint for g in seeing if g.complaint), "")
        if advice.enough or advice.waits or not seeing or advice.frame_gain < min_gain:
            return advice
        return replace(advice, take=not complaint, words=complaint.capitalize() or TAKING)

    def _of_lenses(self, advice: RigAdvice, observations: Sequence[FrameObservation]) -> RigAdvice:
        """Return the advice for the lens with the largest error; without errors, for that with the fewest frames."""
        lenses = advice.lenses
        badly = [(a.enough, a.waits, -a.share, len(lens.views)) for lens, a in zip(self.lenses, lenses, strict=True)]
        advised_camera = min(range(len(lenses)), key=lambda c: badly[c])
        own = lenses[advised_camera]
        return replace(
            advice,
            words=own.words if len(lenses) == 1 else f"{self.names[advised_camera]}: {own.words}",
            frame_gain=max(
                [
                    a.frame_gain
                    for a, g in zip(lenses, observations, strict=True)
                    if not (a.enough or a.waits) and g.view
                ],
                default=0.0,
            ),
            enough=own.enough,
            waits=own.waits,
            advised_camera=advised_camera,
            targets=tuple(a.target_px if c == advised_camera and not a.waits else None for c, a in enumerate(lenses)),
        )

    def _of_mount(self, advice: RigAdvice, observations: Sequence[FrameObservation]) -> RigAdvice:
        """Return the advice for the camera with the least certain mount."""
        c = advice.advised_camera
        if c not in self._asked:
            self._asked[c] = self._shared_target(c)
        words, targets = self._asked[c]
        return replace(advice, words=words, targets=tuple(targets), frame_gain=self._mount_gain(c, observations))

    def _of_rig(self, advice: RigAdvice, observations: Sequence[FrameObservation], *, photo: bool) -> RigAdvice:
        """Return the advice by the rig's calibration, once lenses and mounts seem good enough."""
        self._update_calibration()
        steady = self._full.is_steady(len(self.frames))
        if steady is None:
            return replace(advice, words=CHECKING, waits=True)
        if self._full.latest is None:
            return self._of_mount(replace(advice, advised_camera=1), observations)
        try:
            known = self._knowledge_of(self._full.latest)
        except DegenerateError as error:
            return replace(advice, words=str(error))
        advice = replace(advice, remaining=known.remaining, gain=known.plan.gain)
        would_do = known.reached or known.plan.gain < MIN_GAIN_TO_CONTINUE
        if steady and would_do:
            return replace(advice, words=enough_words(known.remaining, known.plan.gain), enough=True)
        words, targets = known.target()
        if would_do:
            words = f"One more as confirmation: {words[0].lower()}{words[1:]}"
        frame = [observation.view for observation in observations]
        new = any(view is not None and not lens.repeats(view) for lens, view in zip(self.lenses, frame, strict=True))
        frame_gain = known.gain_of(frame, photo=photo) if new else 0.0
        return replace(advice, words=words, targets=tuple(targets), frame_gain=frame_gain)

    def _rig_is_enough(self, lenses: Sequence[Advice]) -> bool:
        """Say whether the rig's calibration is good enough although a lens alone is not: cameras help each other."""
        if not all(lens.has_many for lens in self.lenses):
            return False
        if not all(own.enough or own.share <= MAX_HELP for own in lenses):
            return False
        self._update_calibration()
        if not self._full.is_steady(len(self.frames)) or self._full.latest is None:
            return False
        try:
            return self._knowledge_of(self._full.latest).reached
        except DegenerateError:
            return False

    def _update_calibration(self) -> None:
        """Use finished calibrations, and start one of new frames once each lens has its own: the rig reuses them."""
        if not all(lens.is_calibrated for lens in self.lenses):
            return
        frames = [[observation.view for observation in frame] for frame in self.frames]
        candidate_fits = [lens.candidate_fits for lens in self.lenses if lens.candidate_fits is not None]
        if self._full.update(frames, self.names, [lens.size_px for lens in self.lenses], candidate_fits):
            self._known = None

    def _knowledge_of(self, rig: RigCalibration) -> RigKnowledge:
        self._known = self._known or RigKnowledge.of(rig, self.options)
        return self._known

    def _partner(self, c: int) -> int:
        """Return the camera that saw most boards together with camera `c`."""
        counts = [
            sum(f[c].view is not None and f[k].view is not None for f in self.frames) if k != c else -1
            for k in range(len(self.names))
        ]
        return int(np.argmax(counts))

    def _shared_of(self, c: int) -> SharedViews | None:
        """Return the boards that camera `c` and its partner saw at once; None where there are none."""
        if c not in self._shared:
            a = self._partner(c)
            pairs = [held for held in (self._held_by(a, c, frame) for frame in self.frames) if held is not None]
            self._shared[c] = None
            if pairs:
                in_a, in_b = (_together([pair[k] for pair in pairs]) for k in (0, 1))
                self._shared[c] = self._views(a, c, in_a, in_b)
        return self._shared[c]

    def _views(self, a: int, b: int, in_a: BoardPoses, in_b: BoardPoses) -> SharedViews:
        sizes = [next(f[c].size_px for f in self.frames) for c in (a, b)]
        cameras = [self.lenses[c].camera(size) for c, size in zip((a, b), sizes, strict=True)]
        return SharedViews(cameras[0], cameras[1], in_a, in_b, self.lenses[b].corner_error(sizes[1]))

    def _held_by(self, a: int, b: int, frame: Sequence[FrameObservation]) -> tuple[BoardPoses, BoardPoses] | None:
        first, second = frame[a].view, frame[b].view
        if first is None or second is None or first.board.board_id != second.board.board_id:
            return None
        poses = [self.lenses[c].pose_of(v, frame[c].size_px) for c, v in ((a, first), (b, second))]
        if poses[0] is None or poses[1] is None:
            return None
        return posed_view(first, poses[0]), posed_view(second, poses[1])

    def _mount_px(self, c: int) -> float | None:
        shared = self._shared_of(c)
        if shared is None or len(shared.in_a) < SHARED_FRAMES:
            return None
        return float(mount_error_px(shared, mount_information(shared).sum(axis=0)))

    def _mount_gain(self, c: int, observations: Sequence[FrameObservation]) -> float:
        """Return the gain of this frame for the mount of camera `c`, relative to that of one more typical frame."""
        pair, shared = self._held_by(self._partner(c), c, observations), self._shared_of(c)
        if pair is None:
            return 0.0
        if shared is None or len(shared.in_a) < 2:
            return 1.0
        known = mount_information(shared).sum(axis=0)
        fresh = self._views(self._partner(c), c, *pair)
        before, after = mount_error_px(shared, np.stack([known, known + mount_information(fresh)[0]]))
        typical = 1.0 - np.sqrt(len(shared.in_a) / (len(shared.in_a) + 1.0))
        return float((before - after) / max(before * typical, 1e-12))

    def _shared_target(self, c: int) -> tuple[str, list[Pixels | None]]:
        """Return where to hold the board for the mount of camera `c`, in words and outlines: completely in both views,
        where it has most information."""
        a, shared = self._partner(c), self._shared_of(c)
        targets: list[Pixels | None] = [None] * len(self.names)
        words = f"Hold the board where {self.names[a]} and {self.names[c]} both see it"
        if shared is None:
            return words, targets
        motions = [shared.in_b.pose(k) @ shared.in_a.pose(k).inverse() for k in range(len(shared.in_a))]
        board = self.options.boards[0]
        in_a = board_poses_in_view(shared.a, board, self.options.reach)
        in_b = in_a.transformed(median_motion(motions))
        pixels, valid = shared.b.project(in_b.in_cam(outline_mm(board)))
        both = np.all(valid & shared.b.on_image(pixels), axis=1)
        if not both.any():
            return words, targets
        in_a, in_b = in_a.chosen(both), in_b.chosen(both)
        gained = mount_information(SharedViews(shared.a, shared.b, in_a, in_b, shared.error))
        known = mount_information(shared).sum(axis=0)
        best = int(np.argmin(mount_error_px(shared, known + gained)))
        where = placement(shared.a, board, in_a.pose(best))
        targets[a], targets[c] = where.outline_px, placement(shared.b, board, in_b.pose(best)).outline_px
        return f"{words}: {where} of {self.names[a]}", targets

    def state(self, observations: Sequence[FrameObservation] | None, advice: RigAdvice | None) -> dict[str, Any]:
        """Return the state for the page."""
        out: dict[str, Any] = {"frames": len(self.frames), "least_frames": ENOUGH_FRAMES}
        if advice is not None:
            remaining = advice.remaining or advice.lenses[advice.advised_camera].remaining
            out |= {
                "words": advice.words,
                "take": advice.take,
                "enough": advice.enough,
                "waits": advice.waits,
                "error": ", ".join(map(str, remaining)),
                "share": max((own.share for own in remaining), default=None),
                "mount_px": None if advice.remaining else advice.mount_px,
                "more_percent": advice.more_percent,
            }
        cameras = []
        for c, (name, lens) in enumerate(zip(self.names, self.lenses, strict=True)):
            step = max(1, sum(len(v.pixels) for v in lens.views) // MAX_MARKS)
            seen = np.concatenate([v.pixels for v in lens.views])[::step] if lens.views else np.zeros((0, 2))
            own: dict[str, Any] = {"name": name, "covered": np.round(seen, 1).tolist(), "map": lens.sigma_map()}
            own["size_px"] = lens.size_px
            target = None if advice is None else advice.targets[c]
            if target is not None:
                own["target"] = np.round(target[np.isfinite(target).all(axis=1)], 1).tolist()
            if observations is not None:
                own |= observations[c].shown()
            cameras.append(own)
        return out | {"cameras": cameras}


def _together(held: Sequence[BoardPoses]) -> BoardPoses:
    """Return several poses of one board as one."""
    return BoardPoses(
        held[0].points_mm,
        np.concatenate([h.rotation for h in held]),
        np.concatenate([h.translation_mm for h in held]),
        np.concatenate([h.seen for h in held]),
    )
