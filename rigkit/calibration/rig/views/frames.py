"""Initial values of a rig: mounts of the cameras and poses of the targets, and the orientation of symmetric boards.

The orientation of a board with rotational symmetry is ambiguous between cameras, and frames that are not synchronous
are outliers. Both are resolved by the mount that most frames agree on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.choosing.board_orientation import board_turn, symmetry_turns
from rigkit.calibration.rig.solving.state import Key
from rigkit.calibration.rig.views.observations import (
    FrameObservations,
    Observation,
    Places,
    RigViews,
    outer_corners,
)
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3, Pixels, Points, sampling_step
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation, rotation_angle

MAX_TRIED = 64
"""Number of mounts tried. One from an inlier target in the right orientation is enough: for boards with four
orientations and half of the targets outliers, 64 tries miss all of them once in 5000 times."""
AGREE = 4.0
"""Multiple of the typical distance up to which a target is an inlier of the initial mount."""
RIVAL = 3.0
"""A mount with a typical distance within this factor of the best is a rival if it differs ..."""
OTHER_RAD = 0.5
"""... by this angle: the wrong orientation of a board rotates the mount by 180 degrees, or by twice the board's
tilt."""
ROUNDING_OF_TARGETS = 1e-9
"""Part of the distance by which exact targets differ: rounding."""


@dataclass(frozen=True, eq=False, slots=True)
class _Target:
    """A target seen by a camera: its pose, points on it for comparison, (4, 3) mm, and its possible orientations."""

    rotation: Mat3
    translation_mm: FloatArray
    points: Points
    orientations: tuple[Rigid3, ...]


def _stack(motions: Sequence[Rigid3]) -> tuple[Mat3, Points]:
    return np.array([m.rotation for m in motions]), np.array([m.translation_mm for m in motions])


def places_of(names: Iterable[str], places: Places) -> tuple[Mat3, Points]:
    """Return target_from_board of boards by their names, (n, 3, 3) and (n, 3)."""
    alone = ("", Rigid3.identity())
    return _stack([places.get(name, alone)[1] for name in names])


def target_poses(entries: Sequence[Observation], places: Places) -> tuple[Mat3, Points]:
    """Return cam_from_target of every entry from its board's pose, (n, 3, 3) and (n, 3)."""
    rotation, shift = _stack([e.cam_from_board for e in entries])
    if places:
        place, lever = places_of((e.board_id for e in entries), places)
        rotation = rotation @ np.swapaxes(place, -1, -2)
        shift = shift - (rotation @ lever[..., None])[..., 0]
    return rotation, shift


def _most_seen(own: FrameObservations) -> dict[Key, Observation]:
    """Return the entry with the most corners of every key."""
    out: dict[Key, Observation] = {}
    for entry in own.values():
        known = out.get(entry.key)
        if known is None or entry.kept.sum() > known.kept.sum():
            out[entry.key] = entry
    return out


def _targets(own: FrameObservations, places: Places) -> dict[Key, _Target]:
    best = _most_seen(own)
    if not best:
        return {}
    out = {}
    boards = {entry.board_id: entry.view.board for entry in best.values()}
    looks = {
        name: (outer_corners(board), tuple(board_turn(board, turns) for turns in symmetry_turns(board)))
        for name, board in boards.items()
    }
    for (key, entry), rotation, shift in zip(best.items(), *target_poses(list(best.values()), places), strict=True):
        corners, orientations = looks[entry.board_id]
        if entry.board_id in places:
            # Two cameras may see different boards of the target: points in its own frame are common to both.
            out[key] = _Target(rotation, shift, corners.max() * _FRAME, ALONE)
        else:
            out[key] = _Target(rotation, shift, corners, orientations)
    return out


_FRAME = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
ALONE = (Rigid3.identity(),)


def mounts_of(views: RigViews) -> tuple[list[Rigid3], tuple[Finding, ...]]:
    """Return cam_from_rig of every camera, along a spanning tree of pairs that share the most targets, and findings on
    ambiguities.

    Raises InputError where a camera shares no target.
    """
    names, targets = views.names, [_targets(own, views.places) for own in views.seen]
    mounts: dict[int, Rigid3] = {0: Rigid3.identity()}
    notes: list[Finding] = []
    while len(mounts) < len(targets):
        edges = [(i, j) for i in mounts for j in range(len(targets)) if j not in mounts]
        i, j = max(edges, key=lambda e: len(targets[e[0]].keys() & targets[e[1]].keys()))
        shared = sorted(targets[i].keys() & targets[j].keys())
        if not shared:
            alike = any(entry.is_alone for entry in views.seen[j].values())
            remedy = (
                "images show several boards that look alike, and their arrangement leaves open which is which; declare "
                "boards of each size with their own squares, or mark one of them"
                if alike
                else "take frames in which both see a whole board, and check that simultaneous images have the same "
                "name or number; cameras that never see one board need boards mounted to each other, declared as "
                "[[rigid_boards]] in a session, and images that show these together"
            )
            raise InputError(
                f"rig: camera '{names[j]}' shares no board in any frame with '{names[0]}' or the cameras connected to "
                f"it; {remedy}"
            )
        motion, rival = _motion([(targets[i][key], targets[j][key]) for key in shared])
        if rival is not None:
            notes.append(
                Finding.look(
                    f"cameras '{names[i]}' and '{names[j]}' share only {len(shared)} boards, which are symmetric: an "
                    "extrinsic rotation that differs by "
                    f"{np.degrees(rotation_angle(rival.rotation @ motion.rotation.T)):.0f} deg fits equally well; the "
                    "smaller rotation is used",
                    "tilt the board differently in more frames, or use one with an odd and an even number of corners",
                )
            )
        mounts[j] = motion @ mounts[i]
    return [mounts[k] for k in range(len(targets))], tuple(notes)


def _motion(pairs: Sequence[tuple[_Target, _Target]]) -> tuple[Rigid3, Rigid3 | None]:
    """Return cam2_from_cam1, and a rival that fits as well or None. Candidates are the motions from single targets in
    all their orientations; the result is the median over the inliers of the best one."""
    owner = [k for k, (_, b) in enumerate(pairs) for _ in b.orientations]
    orientations, levers = _stack([turn for _, b in pairs for turn in b.orientations])
    r1, r2 = (np.array([pairs[k][i].rotation for k in owner]) for i in (0, 1))
    t1, t2 = (np.array([pairs[k][i].translation_mm for k in owner]) for i in (0, 1))
    r2 = r2 @ np.swapaxes(orientations, -1, -2)
    t2 = t2 - np.einsum("nij,nj->ni", r2, levers)
    rotation = r2 @ np.swapaxes(r1, -1, -2)
    shift = t2 - np.einsum("nij,nj->ni", rotation, t1)
    points = np.array([pairs[k][0].points for k in owner])
    x1, x2 = (np.einsum("nij,ncj->nci", r, points) + t[:, None] for r, t in ((r1, t1), (r2, t2)))
    distance = np.linalg.norm(x2, axis=-1).mean(axis=-1)
    starts = np.flatnonzero(np.diff([-1, *owner]))
    tried = np.arange(0, len(owner), sampling_step(len(owner), MAX_TRIED))
    off_mm = np.einsum("hij,ncj->hnci", rotation[tried], x1) + shift[tried, None, None] - x2
    offs = np.sqrt(np.einsum("hnci,hnci->hnc", off_mm, off_mm)).mean(axis=-1) / distance
    typical = np.median(np.minimum.reduceat(offs, starts, axis=1), axis=1)
    angle = rotation_angle(rotation[tried])
    # Of those that fit equally well, the one with the smaller rotation between the cameras is more likely.
    best = int(np.argmin(typical))
    alike = np.flatnonzero(typical <= RIVAL * typical[best] + ROUNDING_OF_TARGETS)
    turned = rotation_angle(rotation[tried[alike]] @ rotation[tried[best]].T)
    rivals = alike[turned > OTHER_RAD]
    ambiguous = len(rivals) > 0 and any(len(b.orientations) > 1 for _, b in pairs)
    if ambiguous:
        best = int(min([best, *rivals.tolist()], key=lambda m: angle[m]))
    near = offs[best] <= AGREE * typical[best] + ROUNDING_OF_TARGETS
    middle = Rigid3(nearest_rotation(np.median(rotation[near], axis=0)), np.median(shift[near], axis=0))
    if not ambiguous:
        return middle, None
    others = [m for m in alike.tolist() if rotation_angle(rotation[tried[m]] @ middle.rotation.T) > OTHER_RAD]
    return middle, Rigid3(rotation[tried[others[0]]], shift[tried[others[0]]]) if others else None


def with_common_orientation(views: RigViews, mounts: Sequence[Rigid3]) -> RigViews:
    """Return the views with every board numbered from the same corner as in the first camera that sees it."""
    out: list[FrameObservations] = []
    for k, own in enumerate(views.seen):
        mine: FrameObservations = {}
        for key, entry in own.items():
            before = next((i for i in range(k) if key in views.seen[i]), None)
            looks = symmetry_turns(entry.view.board)
            if before is None or len(looks) == 1 or entry.board_id in views.places:
                mine[key] = entry
                continue
            expected = mounts[k] @ mounts[before].inverse() @ out[before][key].cam_from_board
            points = entry.view.board.points()
            orientations = [entry.turned(turns) for turns in looks]
            off = [float(np.linalg.norm(w.cam_from_board.apply(points) - expected.apply(points))) for w in orientations]
            mine[key] = orientations[int(np.argmin(off))]
        out.append(mine)
    return views.with_seen(out)


def view_distances_px(views: RigViews, mounts: Sequence[Rigid3]) -> dict[Key, float]:
    """Return for each target the distance in px between views that share its pose, by transfer of its corners: for two
    cameras the smaller of both directions (a board's pose may be inaccurate in one image), for more the worst pair of
    cameras or of boards."""
    out: dict[Key, float] = {}
    # A camera without views has no distance.
    some = [k for k, own in enumerate(views.seen) if own]
    best = {k: _most_seen(views.seen[k]) for k in some}
    corners = {k: _CameraCorners.of(views.seen[k]) for k in some}

    def transfer_px(i: int, j: int) -> dict[Key, float]:
        return _transfer_px(best[i], corners[j], mounts[j] @ mounts[i].inverse(), views.cameras[j], views.places)

    for n, i in enumerate(some):
        for j in some[n:]:
            there = transfer_px(i, j)
            back = there if i == j else transfer_px(j, i)
            for key in there:
                out[key] = max(out.get(key, 0.0), min(there[key], back[key]))
    return out


@dataclass(frozen=True, eq=False, slots=True)
class _CameraCorners:
    """All corners of a camera, entry by entry: the entries, the number of corners of each, the corners on their boards
    (N, 3) mm and in the image (N, 2), and the inliers (N,)."""

    entries: list[Observation]
    counts: IntArray
    points: Points
    pixels: Pixels
    kept: BoolArray

    @classmethod
    def of(cls, own: FrameObservations) -> _CameraCorners:
        entries = list(own.values())
        boards = {e.board_id: e.view.board for e in entries}
        table = {name: board.points() for name, board in boards.items()}
        rows = [table[e.board_id][boards[e.board_id].index(e.view.grid)] for e in entries]
        counts = np.array([len(r) for r in rows], dtype=np.int64)
        pixels, kept = [e.view.pixels for e in entries], [e.kept for e in entries]
        return cls(entries, counts, np.concatenate(rows), np.concatenate(pixels), np.concatenate(kept))


def _transfer_px(
    first: Mapping[Key, Observation], second: _CameraCorners, motion: Rigid3, camera: Camera, places: Places
) -> dict[Key, float]:
    """Return the RMS distance of each target's corners in the second camera from their projection with the pose from
    the first camera; of several boards the worst."""
    chosen = np.array([first.get(e.key, e) is not e for e in second.entries])
    if not chosen.any():
        return {}
    entries = [e for e, c in zip(second.entries, chosen, strict=True) if c]
    counts, mask = second.counts[chosen], np.repeat(chosen, second.counts)
    turn, place = target_poses([first[e.key] for e in entries], places)
    turn, place = motion.rotation @ turn, motion.apply(place)
    if places:
        own, lever = places_of((e.board_id for e in entries), places)
        turn, place = turn @ own, place + (turn @ lever[..., None])[..., 0]
    in_cam = np.einsum("nij,nj->ni", np.repeat(turn, counts, axis=0), second.points[mask])
    in_cam += np.repeat(place, counts, axis=0)
    pixels, valid = camera.project(in_cam)
    use = valid & second.kept[mask]
    off = pixels - second.pixels[mask]
    squared = np.where(use, np.einsum("ni,ni->n", off, off), 0.0)
    starts = np.cumsum([0, *counts[:-1]])
    number = np.add.reduceat(use.astype(np.float64), starts)
    rms = np.where(number > 0, np.sqrt(np.add.reduceat(squared, starts) / np.maximum(number, 1.0)), np.inf)
    out: dict[Key, float] = {}
    for entry, value in zip(entries, rms.tolist(), strict=True):
        out[entry.key] = max(out.get(entry.key, 0.0), value)
    return out


def initial_target_poses(keys: Sequence[Key], views: RigViews, mounts: Sequence[Rigid3]) -> tuple[Mat3, Points]:
    """Return rig_from_target of every key, from the view with the most corners."""
    best: dict[Key, tuple[int, int, Observation]] = {}
    for k, own in enumerate(views.seen):
        for key, entry in _most_seen(own).items():
            count = int(entry.kept.sum())
            if key not in best or count > best[key][0]:
                best[key] = (count, k, entry)
    rotation, shift = target_poses([best[key][2] for key in keys], views.places)
    back = [m.inverse() for m in mounts]
    turn, place = _stack([back[best[key][1]] for key in keys])
    return turn @ rotation, (turn @ shift[..., None])[..., 0] + place
