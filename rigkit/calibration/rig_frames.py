"""Before a rig is solved: which views show the same board at the same moment, and where the cameras roughly sit.

A board that looks the same when turned has no first corner that two cameras agree on, and a frame whose images were not
taken at one moment fits nothing. Both are settled by the mount that most frames agree on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, Mat3, Points
from rigkit.boards import Board
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.detections import BoardView
from rigkit.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation

__all__ = ["Key", "Seen", "apart", "first_frames", "mounts_of", "seen_by", "turned_alike"]

Key = tuple[str, str]
"""(frame, board): cameras that have a key in common see the same board in the same place."""

MAX_TRIED = 200
"""Mounts tried; more of them find no better one."""
AGREE = 4.0
"""Frames whose board lies within this many times the typical distance make the first mount."""


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """A board in an image, as the camera's own calibration left it; `squared_px` is what its kept corners leave."""

    view: BoardView
    kept: BoolArray
    cam_from_board: Rigid3
    squared_px: float

    def turned(self, quarter_turns: int) -> Seen:
        """Return the same with the corners counted from another corner of the board."""
        if quarter_turns == 0:
            return self
        board = self.view.board
        (column, row), columns, rows = self.view.grid.T, board.columns, board.rows
        for _ in range(quarter_turns):
            column, row = rows - 1 - row, column
            columns, rows = rows, columns
        grid = np.stack([column, row], axis=-1)
        angle = 0.5 * np.pi * quarter_turns
        turn = np.rint([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        shift = board.points(grid[:1])[0] - turn @ board.points(self.view.grid[:1])[0]
        pose = self.cam_from_board @ Rigid3(turn, shift).inverse()
        return replace(self, view=replace(self.view, grid=grid), cam_from_board=pose)


def seen_by(own: Sequence[tuple[str, BoardView]], result: Calibration) -> dict[Key, Seen]:
    """Return the views that the camera's own calibration used, by (frame, board)."""
    used = {(v.image, v.board_id): v for v in result.views}
    out = {}
    for frame, view in own:
        entry = used.get((view.image, view.board.board_id))
        if entry is not None:
            left = float((entry.residuals_px[entry.kept] ** 2).sum())
            out[(frame, view.board.board_id)] = Seen(view, entry.kept, entry.cam_from_board, left)
    return out


def mounts_of(names: Sequence[str], seen: Sequence[Mapping[Key, Seen]]) -> list[Rigid3]:
    """Return cam_from_rig of every camera, along a tree of pairs that share the most boards.

    Raises InputError where a camera shares none.
    """
    mounts: dict[int, Rigid3] = {0: Rigid3.identity()}
    while len(mounts) < len(seen):
        edges = [(i, j) for i in mounts for j in range(len(seen)) if j not in mounts]
        i, j = max(edges, key=lambda e: len(seen[e[0]].keys() & seen[e[1]].keys()))
        shared = sorted(seen[i].keys() & seen[j].keys())
        if not shared:
            raise InputError(
                f"rig: camera '{names[j]}' shares no board in any frame with '{names[0]}' or the cameras that hang "
                "together with it; take frames in which both see a board, and check the names of the frames"
            )
        mounts[j] = _motion([(seen[i][key], seen[j][key]) for key in shared]) @ mounts[i]
    return [mounts[k] for k in range(len(seen))]


def _motion(pairs: Sequence[tuple[Seen, Seen]]) -> Rigid3:
    """Return cam2_from_cam1: of the motions of the single boards, turned in all ways that look the same, the one that
    most boards agree on, and then the middle of those that do."""
    owner, poses, corners = [], [], []
    for k, (a, b) in enumerate(pairs):
        board = a.view.board
        for turns in _same_looks(board):
            owner.append(k)
            poses.append((a.cam_from_board, b.turned(turns).cam_from_board))
            corners.append(board.points()[[0, board.columns - 1, -board.columns, -1]])
    r1, r2 = (np.array([p[i].rotation for p in poses]) for i in (0, 1))
    t1, t2 = (np.array([p[i].translation_mm for p in poses]) for i in (0, 1))
    rotation = r2 @ np.swapaxes(r1, -1, -2)
    shift = t2 - np.einsum("nij,nj->ni", rotation, t1)
    points = np.array(corners)
    x1, x2 = (np.einsum("nij,ncj->nci", r, points) + t[:, None] for r, t in ((r1, t1), (r2, t2)))
    distance = np.linalg.norm(x2, axis=-1).mean(axis=-1)
    starts = np.flatnonzero(np.diff([-1, *owner]))
    best, usual = np.zeros(0), np.inf
    for k in range(0, len(owner), -(-len(owner) // MAX_TRIED)):
        off = np.linalg.norm(x1 @ rotation[k].T + shift[k] - x2, axis=-1).mean(axis=-1) / distance
        typical = float(np.median(np.minimum.reduceat(off, starts)))
        if typical < usual:
            best, usual = off, typical
    near = best <= AGREE * usual + 1e-12
    middle = nearest_rotation(np.median(rotation[near], axis=0))
    return Rigid3(middle, np.median(shift[near], axis=0))


def _same_looks(board: Board) -> tuple[int, ...]:
    """Return the quarter turns after which the board looks as before."""
    if not board.looks_same_turned:
        return (0,)
    square = board.columns == board.rows and board.columns % 2 == 0 and board.square_x_mm == board.square_y_mm
    return (0, 1, 2, 3) if square else (0, 2)


def turned_alike(seen: Sequence[Mapping[Key, Seen]], mounts: Sequence[Rigid3]) -> list[dict[Key, Seen]]:
    """Return the views with every board counted from the corner from which the first camera that sees it counts."""
    out: list[dict[Key, Seen]] = []
    for k, own in enumerate(seen):
        mine: dict[Key, Seen] = {}
        for key, entry in own.items():
            before = next((i for i in range(k) if key in seen[i]), None)
            looks = _same_looks(entry.view.board)
            if before is None or len(looks) == 1:
                mine[key] = entry
                continue
            expected = mounts[k] @ mounts[before].inverse() @ out[before][key].cam_from_board
            points = entry.view.board.points()
            ways = [entry.turned(turns) for turns in looks]
            off = [float(np.linalg.norm(w.cam_from_board.apply(points) - expected.apply(points))) for w in ways]
            mine[key] = ways[int(np.argmin(off))]
        out.append(mine)
    return out


def apart(seen: Sequence[Mapping[Key, Seen]], mounts: Sequence[Rigid3], cameras: Sequence[Camera]) -> dict[Key, float]:
    """Return how far apart two cameras put each board that they share, in px: the worst pair of cameras, the better of
    its two directions (a board's pose may be bad in one of the images)."""
    out: dict[Key, float] = {}
    for i in range(len(seen)):
        for j in range(i + 1, len(seen)):
            motion = mounts[j] @ mounts[i].inverse()
            shared = sorted(seen[i].keys() & seen[j].keys())
            if not shared:
                continue
            first, second = ([own[key] for key in shared] for own in (seen[i], seen[j]))
            there = _transfer_px(first, second, motion, cameras[j])
            back = _transfer_px(second, first, motion.inverse(), cameras[i])
            for key, off in zip(shared, np.minimum(there, back).tolist(), strict=True):
                out[key] = max(out.get(key, 0.0), off)
    return out


def _transfer_px(first: Sequence[Seen], second: Sequence[Seen], motion: Rigid3, camera: Camera) -> FloatArray:
    """Return the RMS distance of each board's corners in the second camera from where the first's pose puts them."""
    counts = [len(s.view.grid) for s in second]
    rotation = np.repeat(motion.rotation @ np.array([s.cam_from_board.rotation for s in first]), counts, axis=0)
    shift = np.repeat(motion.apply(np.array([s.cam_from_board.translation_mm for s in first])), counts, axis=0)
    points = np.concatenate([s.view.points() for s in second])
    pixels, valid = camera.project((rotation @ points[..., None])[..., 0] + shift)
    use = valid & np.concatenate([s.kept for s in second])
    off = pixels - np.concatenate([s.view.pixels for s in second])
    squared = np.where(use, np.einsum("ni,ni->n", off, off), 0.0)
    starts = np.cumsum([0, *counts[:-1]])
    number = np.add.reduceat(use.astype(np.float64), starts)
    return np.where(number > 0, np.sqrt(np.add.reduceat(squared, starts) / np.maximum(number, 1.0)), np.inf)


def first_frames(
    keys: Sequence[Key], seen: Sequence[Mapping[Key, Seen]], mounts: Sequence[Rigid3]
) -> tuple[Mat3, Points]:
    """Return rig_from_board of every (frame, board), from the camera that sees most of its corners."""
    rotation: list[FloatArray] = []
    translation: list[FloatArray] = []
    for key in keys:
        k = max((k for k in range(len(seen)) if key in seen[k]), key=lambda k: int(seen[k][key].kept.sum()))
        pose = mounts[k].inverse() @ seen[k][key].cam_from_board
        rotation.append(pose.rotation)
        translation.append(pose.translation_mm)
    return np.array(rotation), np.array(translation)
