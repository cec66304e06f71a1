"""Boards mounted to each other: their identification in every image, and their approximate poses on the target.

Boards that look alike, or have rotational symmetry, are identified and oriented by their arrangement. A scene (an
image) that shows most of them is the reference. In every other scene all ids and orientations of one board are tried.
Each gives a pose of the target, and the one that predicts the other boards of the scene best is taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.choosing.board_orientation import symmetry_turns
from rigkit.calibration.rig.views.observations import FrameObservations, Observation, RigViews, outer_corners
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation

REFERENCES = 5
"""Number of scenes tried as the reference: a bad one explains the others badly."""
RIVAL = 3.0
"""A scene is ambiguous if another assignment of ids has a misfit within this factor."""
FITS = 0.1
"""Largest misfit of a board, as a part of its distance from the camera."""
FLOOR = 1e-6
"""Smallest misfit, as a part of the distance: rounding."""


@dataclass(frozen=True, eq=False, slots=True)
class _LabelledBoard:
    """A possible id and orientation of an observed board, with its outer corners in the camera, (4, 3) mm."""

    seen: Observation
    corners: FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class _BoardInScene:
    """A board of a scene: its camera, its key there, its possible labels, and its distance."""

    camera: int
    key: tuple[str, str]
    labels: tuple[_LabelledBoard, ...]
    distance_mm: float


def board_places(
    groups: Sequence[Sequence[str]], views: RigViews, boards: Mapping[str, Board]
) -> tuple[RigViews, tuple[Finding, ...]]:
    """Return the views with the boards of every group identified, oriented consistently, and assigned to their target
    with their poses on it, and findings on ambiguous scenes.

    Raises InputError: a board of a group is never seen together with the others, or they cannot be identified.

    Parameters
    ----------
    groups : ids of the boards that are mounted to each other.
    boards : all boards by id.
    """
    out = [dict(own) for own in views.seen]
    places: dict[str, tuple[str, Rigid3]] = {}
    notes: list[Finding] = []
    for group in groups:
        members = [boards[name] for name in group]
        scenes = _scenes(out, members)
        found = _best_reference(scenes, members)
        if found is None:
            raise InputError(
                f"rigid boards {', '.join(group)}: no image shows two of them; take images that show several at once"
            )
        known, labellings = found
        single = _unidentified_board(group, known, scenes, labellings)
        if single is not None:
            raise InputError(
                f"rigid boards {', '.join(group)}: '{single}' is never seen together with the others; take images that "
                "show it with one of them"
            )
        first = next(name for name in group if name in known)
        origin = known[first].inverse()
        for name, pose in known.items():
            places[name] = (first, origin @ pose)
        for scene, labelling in zip(scenes, labellings, strict=True):
            _rename(out[scene[0].camera], scene, labelling, first)
        open_scenes = sum(r is None and len(s) > 1 for s, r in zip(scenes, labellings, strict=True))
        if open_scenes:
            notes.append(
                Finding.look(
                    f"in {open_scenes} of {len(scenes)} images the boards {', '.join(group)} cannot be identified; "
                    "there their relative poses are not used"
                )
            )
    return replace(views, seen=out, places=places), tuple(notes)


def _rename(own: FrameObservations, scene: Sequence[_BoardInScene], labelling: Labelling | None, target: str) -> None:
    """Set the ids of the boards of one scene, in the observations of their camera, and the key of their target."""
    old = [own.pop(entry.key) for entry in scene]
    for k, (entry, before) in enumerate(zip(scene, old, strict=True)):
        label = None if labelling is None else labelling.get(k)
        if label is not None:
            own[(before.frame, label.board_id)] = replace(label, key=(before.frame, target))
            continue
        # Its pose on the target is unknown: it remains a view of an independent board.
        alone = before.alone(entry.camera)
        own[alone.key] = alone


def _unidentified_board(
    group: Sequence[str],
    known: Mapping[str, Rigid3],
    scenes: Sequence[list[_BoardInScene]],
    labellings: Sequence[Labelling | None],
) -> str | None:
    """Return a board that was seen, but in no scene that determines its pose on the target; None if there is none."""
    read: dict[str, bool] = {}
    for scene, labelling in zip(scenes, labellings, strict=True):
        for k, entry in enumerate(scene):
            name = entry.key[1]
            read[name] = read.get(name, False) or (labelling is not None and k in labelling)
    return next((name for name in group if name not in known and not read.get(name, True)), None)


def _scenes(seen: Sequence[FrameObservations], members: Sequence[Board]) -> list[list[_BoardInScene]]:
    """Return the boards of the group in every image of every camera."""
    names = {b.board_id for b in members}
    scenes: dict[tuple[int, str], list[_BoardInScene]] = {}
    for c, own in enumerate(seen):
        for key, entry in own.items():
            if entry.board_id in names:
                labels = tuple(_possible_labels(entry, members))
                distance = float(np.linalg.norm(labels[0].corners.mean(axis=0)))
                scenes.setdefault((c, entry.frame), []).append(_BoardInScene(c, key, labels, distance))
    return list(scenes.values())


def _possible_labels(entry: Observation, members: Sequence[Board]) -> list[_LabelledBoard]:
    """Return all possible labels of a board, the given one first."""
    own = entry.view.board
    found = []
    for board in sorted(members, key=lambda b: b.board_id != own.board_id):
        straight = (
            board.size == own.size and board.square_x_mm == own.square_x_mm and board.square_y_mm == own.square_y_mm
        )
        across = board.size == own.size[::-1] and board.square_x_mm == own.square_y_mm
        across = across and board.square_y_mm == own.square_x_mm
        turns = [*(symmetry_turns(own) if straight else ()), *((1, 3) if across and own.columns != own.rows else ())]
        for count in turns:
            seen = entry.turned(count, board)
            found.append(_LabelledBoard(seen, seen.cam_from_board.apply(outer_corners(board))))
    return found


Labelling = dict[int, Observation]
"""Index of the board in its scene -> the observation with the id and orientation assigned."""


def _best_reference(
    scenes: Sequence[list[_BoardInScene]], members: Sequence[Board]
) -> tuple[dict[str, Rigid3], list[Labelling | None]] | None:
    """Return target_from_board of every board found, in the frame of the reference, and the reading of every scene;
    None if no scene has two boards."""
    order = sorted((s for s in scenes if len(s) > 1), key=lambda s: -len(s))
    best = None
    for reference in order[:REFERENCES]:
        known, labellings, residual = _labelled_from(reference, scenes, members)
        if best is None or (len(known), -residual) > (len(best[0]), -best[2]):
            best = known, labellings, residual
    return None if best is None else (best[0], best[1])


def _labelled_from(
    reference: list[_BoardInScene], scenes: Sequence[list[_BoardInScene]], members: Sequence[Board]
) -> tuple[dict[str, Rigid3], list[Labelling | None], float]:
    """Return the boards' poses on the target, the readings of all scenes with one of them as the reference, and the
    median misfit, as a part of the distance."""
    far = {b.board_id: outer_corners(b) for b in members}
    known: dict[str, Rigid3] = {}
    for entry in reference:
        label = next((w.seen for w in entry.labels if w.seen.board_id not in known), None)
        if label is not None:
            known[label.board_id] = label.cam_from_board
    labellings: dict[int, Labelling | None] = {}
    residuals: list[float] = []
    # Scenes that add a known board are read before the ones that need it.
    waiting = sorted(range(len(scenes)), key=lambda i: -len(scenes[i]))
    for last in (False, True):
        left = []
        for i in waiting:
            labelling, residual = _labelled(scenes[i], known, far)
            if labelling is None and not last:
                left.append(i)
                continue
            labellings[i] = labelling
            if labelling is not None:
                residuals.append(residual)
        waiting = left
    middles = _median_poses([r for r in labellings.values() if r is not None], known)
    return middles, [labellings[i] for i in range(len(scenes))], float(np.median(residuals)) if residuals else np.inf


def _labelled(
    scene: list[_BoardInScene], known: dict[str, Rigid3], far: Mapping[str, FloatArray]
) -> tuple[Labelling | None, float]:
    """Return the reading of a scene, None if it is ambiguous, and its misfit. Boards that are not in `known` are added
    to it if the others determine the target's pose."""
    names = list(known)
    ends = np.array([known[name].apply(far[name]) for name in names])
    flat = [(k, w) for k, entry in enumerate(scene) for w in entry.labels]
    corners = np.array([w.corners for _, w in flat])
    reach = np.array([scene[k].distance_mm for k, _ in flat])
    owner = np.array([k for k, _ in flat])
    index = np.array([names.index(w.seen.board_id) if w.seen.board_id in known else -1 for _, w in flat])
    if len(scene) == 1 and len(flat) > 1:
        return None, np.inf
    tried: list[tuple[float, dict[int, int], Rigid3]] = []
    for h, (_, label) in enumerate(flat):
        if index[h] < 0:
            continue
        scene_from_target = label.seen.cam_from_board @ known[label.seen.board_id].inverse()
        expected = scene_from_target.apply(ends)
        off = np.linalg.norm(corners - expected[np.maximum(index, 0)], axis=-1).mean(axis=-1) / reach
        off[index < 0] = np.inf
        chosen: dict[int, int] = {}
        for m in np.argsort(off, kind="stable").tolist():
            taken = {index[v] for v in chosen.values()}
            if off[m] <= FITS and int(owner[m]) not in chosen and index[m] not in taken:
                chosen[int(owner[m])] = m
        total = sum(float(off[m]) for m in chosen.values()) / max(len(chosen) - 1, 1)
        tried.append((total, chosen, scene_from_target))
    if not tried:
        return None, np.inf
    most = max(len(chosen) for _, chosen, _ in tried)
    if most < 2 and len(scene) > 1 and len(known) > 1:
        # No two boards fit: they moved, or none of them is known yet.
        ambiguous = len({tuple(c.items()) for _, c, _ in tried}) > 1
        if ambiguous:
            return None, np.inf
    tried = sorted((t for t in tried if len(t[1]) == most), key=lambda t: t[0])
    total, chosen, scene_from_target = tried[0]
    rival = next((t for t, other, _ in tried if other != chosen), np.inf)
    if most > 1 and rival <= RIVAL * max(total, FLOOR):
        return None, np.inf
    labelling = {k: flat[m][1].seen for k, m in chosen.items()}
    back = scene_from_target.inverse()
    for k, entry in enumerate(scene):
        vacant = [w.seen for w in entry.labels if w.seen.board_id not in known]
        if k not in labelling and vacant:
            labelling[k] = vacant[0]
            known[vacant[0].board_id] = back @ vacant[0].cam_from_board
    return labelling, total


def _median_poses(labellings: Sequence[Labelling], known: Mapping[str, Rigid3]) -> dict[str, Rigid3]:
    """Return the median poses of the boards over the scenes, in the frame of the board that is seen most."""
    by_name = [{s.board_id: s.cam_from_board for s in labelling.values()} for labelling in labellings]
    counts = {name: sum(name in scene for scene in by_name) for name in known}
    anchor = max(known, key=lambda name: counts[name])
    out = {}
    for name, pose in known.items():
        both = [scene[anchor].inverse() @ scene[name] for scene in by_name if name in scene and anchor in scene]
        if name == anchor or not both:
            out[name] = known[anchor].inverse() @ pose
            continue
        rotation = nearest_rotation(np.median([m.rotation for m in both], axis=0))
        out[name] = Rigid3(rotation, np.median([m.translation_mm for m in both], axis=0))
    return out
