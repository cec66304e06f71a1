"""Several cameras whose frames are taken together: every lens by its own guide, and the mounts by the boards that two
cameras see at once. Of one camera it is that camera's guide.

The lens that is worst off says what to do, until all are well; then the camera whose mount is least sure does.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigkit.coach.guide import Advice, CaptureGuide, GuideOptions, held_view, least_worth_of
from rigkit.coach.look import Glance
from rigkit.core.arrays import Pixels
from rigkit.planning.candidates import held_boards, outline_mm
from rigkit.planning.information import HeldBoards
from rigkit.planning.mounts import SharedViews, mean_motion, mount_error_px, mount_information
from rigkit.planning.words import placement

SHARED_FRAMES = 5
"""Fewer boards that two cameras see at once do not tell how these disagree."""
TAKING = "Good: taking it"
MAX_MARKS = 1500
"""Corners that are drawn, at the most."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigAdvice:
    """What the coach says: words, what these frames bring as a part of what a board in the outline would, whether to
    take them, whether there are enough or nothing is asked for until that is known (`waits`), the number of the camera
    that it speaks of, what each camera's guide says, outlines (K, 2) to hold the board into by camera (None: none), and
    how wrong the mounts are (px; None where nobody knows)."""

    words: str
    worth: float
    take: bool
    enough: bool
    waits: bool
    speaks: int
    lenses: tuple[Advice, ...]
    targets: tuple[Pixels | None, ...]
    mount_px: float | None


class RigGuide:
    """Frames that all cameras took together, and what follows from them."""

    def __init__(self, names: Sequence[str], options: GuideOptions, executor: Executor | None = None) -> None:
        self.names, self.options = tuple(names), options
        self.lenses = tuple(CaptureGuide(options, executor) for _ in names)
        self.frames: list[tuple[Glance, ...]] = []
        self._shared: dict[int, SharedViews | None] = {}
        self._asked: dict[int, tuple[str, list[Pixels | None]]] = {}

    def add(self, glances: Sequence[Glance]) -> None:
        """Take a frame of every camera."""
        self.frames.append(tuple(glances))
        self._shared.clear()
        self._asked.clear()
        for lens, glance in zip(self.lenses, glances, strict=True):
            if glance.view is not None:
                lens.add(glance.view, glance.size_px)

    def advise(self, glances: Sequence[Glance], *, photo: bool = False) -> RigAdvice:
        """Return what to do, and whether to take these frames, or photos."""
        least_worth = least_worth_of(photo=photo)
        lenses = tuple(lens.advise(glance, photo=photo) for lens, glance in zip(self.lenses, glances, strict=True))
        seeing = [g for g in glances if g.view is not None]
        good = bool(seeing) and not any(g.complaint for g in seeing)
        # Nobody knows an error: the lens with the fewest frames goes first.
        badly = [
            (advice.enough, advice.waits, -(np.inf if advice.error is None else advice.error), len(lens.views))
            for lens, advice in zip(self.lenses, lenses, strict=True)
        ]
        speaks = min(range(len(lenses)), key=lambda c: badly[c])
        mounts = {c: self._mount_px(c) for c in range(1, len(lenses))}
        open_mounts = [c for c, px in mounts.items() if px is None or px > self.options.goal_px]
        known_px = [px for px in mounts.values() if px is not None]
        mount_px = max(known_px) if mounts and len(known_px) == len(mounts) else None
        enough = all(advice.enough for advice in lenses) and not open_mounts
        worth = max(
            [a.worth for a, g in zip(lenses, glances, strict=True) if not (a.enough or a.waits) and g.view], default=0.0
        )
        words, targets = (
            lenses[speaks].words,
            [a.target_px if c == speaks and not a.waits else None for c, a in enumerate(lenses)],
        )
        if len(lenses) > 1 and not enough:
            words = f"{self.names[speaks]}: {words}"
        if lenses[speaks].enough and open_mounts:
            speaks = max(open_mounts, key=lambda c: np.inf if mounts[c] is None else float(mounts[c] or 0.0))
            if speaks not in self._asked:
                self._asked[speaks] = self._shared_target(speaks)
            words, targets = self._asked[speaks]
            worth = self._shared_worth(speaks, glances)
        take = good and worth >= least_worth and not enough
        if take:
            words = TAKING
        elif not enough and worth >= least_worth:
            words = next((g.complaint.capitalize() for g in seeing if g.complaint), words)
        return RigAdvice(
            words=words,
            worth=worth,
            take=take,
            enough=enough,
            waits=lenses[speaks].waits,
            speaks=speaks,
            lenses=lenses,
            targets=tuple(targets),
            mount_px=mount_px,
        )

    def _partner(self, c: int) -> int:
        """Return the camera that saw most boards together with camera `c`."""
        counts = [
            sum(f[c].view is not None and f[k].view is not None for f in self.frames) if k != c else -1
            for k in range(len(self.names))
        ]
        return int(np.argmax(counts))

    def _shared_of(self, c: int) -> SharedViews | None:
        """Return the boards that camera `c` and its partner saw at once; None before there is one."""
        if c not in self._shared:
            a = self._partner(c)
            pairs = [held for held in (self._held_by(a, c, frame) for frame in self.frames) if held is not None]
            self._shared[c] = None
            if pairs:
                in_a, in_b = (_together([pair[k] for pair in pairs]) for k in (0, 1))
                self._shared[c] = self._views(a, c, in_a, in_b)
        return self._shared[c]

    def _views(self, a: int, b: int, in_a: HeldBoards, in_b: HeldBoards) -> SharedViews:
        sizes = [next(f[c].size_px for f in self.frames) for c in (a, b)]
        cameras = [self.lenses[c].camera(size) for c, size in zip((a, b), sizes, strict=True)]
        return SharedViews(cameras[0], cameras[1], in_a, in_b, self.lenses[b].corner_error(sizes[1]))

    def _held_by(self, a: int, b: int, frame: Sequence[Glance]) -> tuple[HeldBoards, HeldBoards] | None:
        first, second = frame[a].view, frame[b].view
        if first is None or second is None or first.board.board_id != second.board.board_id:
            return None
        poses = [self.lenses[c].pose_of(v, frame[c].size_px) for c, v in ((a, first), (b, second))]
        if poses[0] is None or poses[1] is None:
            return None
        return held_view(first, poses[0]), held_view(second, poses[1])

    def _mount_px(self, c: int) -> float | None:
        shared = self._shared_of(c)
        if shared is None or len(shared.in_a) < SHARED_FRAMES:
            return None
        return float(mount_error_px(shared, mount_information(shared).sum(axis=0)))

    def _shared_worth(self, c: int, glances: Sequence[Glance]) -> float:
        """Return what this frame brings to the mount of camera `c`, as a part of what one more usual frame would."""
        pair, shared = self._held_by(self._partner(c), c, glances), self._shared_of(c)
        if pair is None:
            return 0.0
        if shared is None or len(shared.in_a) < 2:
            return 1.0
        known = mount_information(shared).sum(axis=0)
        fresh = self._views(self._partner(c), c, *pair)
        before, after = mount_error_px(shared, np.stack([known, known + mount_information(fresh)[0]]))
        usual = 1.0 - np.sqrt(len(shared.in_a) / (len(shared.in_a) + 1.0))
        return float((before - after) / max(before * usual, 1e-12))

    def _shared_target(self, c: int) -> tuple[str, list[Pixels | None]]:
        """Return where to hold the board for the mount of camera `c`, in words and outlines: where both see all of it,
        and it tells most."""
        a, shared = self._partner(c), self._shared_of(c)
        targets: list[Pixels | None] = [None] * len(self.names)
        words = f"Hold the board where {self.names[a]} and {self.names[c]} both see it"
        if shared is None:
            return words, targets
        motions = [shared.in_b.pose(k) @ shared.in_a.pose(k).inverse() for k in range(len(shared.in_a))]
        board = self.options.boards[0]
        in_a = held_boards(shared.a, board, self.options.reach)
        in_b = in_a.carried(mean_motion(motions))
        pixels, valid = shared.b.project(in_b.in_cam(outline_mm(board)))
        both = np.all(valid & shared.b.on_image(pixels), axis=1)
        if not both.any():
            return words, targets
        in_a, in_b = in_a.chosen(both), in_b.chosen(both)
        told = mount_information(SharedViews(shared.a, shared.b, in_a, in_b, shared.error))
        known = mount_information(shared).sum(axis=0)
        best = int(np.argmin(mount_error_px(shared, known + told)))
        where = placement(shared.a, board, in_a.pose(best))
        targets[a], targets[c] = where.outline_px, placement(shared.b, board, in_b.pose(best)).outline_px
        return f"{words}: {where} of {self.names[a]}", targets

    def state(self, glances: Sequence[Glance] | None, advice: RigAdvice | None) -> dict[str, Any]:
        """Return what the page shows."""
        out: dict[str, Any] = {"frames": len(self.frames)}
        if advice is not None:
            first = advice.lenses[advice.speaks]
            errors = [a.error_px for a in advice.lenses]
            out |= {
                "words": advice.words,
                "take": advice.take,
                "enough": advice.enough,
                "waits": advice.waits,
                "error": first.error,
                "unit": first.unit,
                "goal": self.options.wanted,
                "error_px": None if None in errors else max(e for e in errors if e is not None),
                "mount_px": advice.mount_px,
                "goal_px": self.options.goal_px,
                "more_percent": first.more_percent,
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
            if glances is not None:
                own |= glances[c].shown()
            cameras.append(own)
        return out | {"cameras": cameras}


def _together(held: Sequence[HeldBoards]) -> HeldBoards:
    """Return boards of one kind as one."""
    return HeldBoards(
        held[0].points_mm,
        np.concatenate([h.rotation for h in held]),
        np.concatenate([h.translation_mm for h in held]),
        np.concatenate([h.seen for h in held]),
    )
