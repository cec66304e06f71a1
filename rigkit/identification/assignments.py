"""Assignment of the boards of image 1 to those of image 2: hypotheses from single boards, extended and refined jointly.

One detection in each image, assumed to be the same board in the same position, determines the relative pose of the
cameras, which predicts all other boards in image 2. Detections that fit their predictions extend the assignment, and a
joint least squares fit of all their corners gives its chi square.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError
from rigkit.identification.board_matches import BoardMatch, ImagePair
from rigkit.identification.joint_pose import BoardCorners, JointPose, refine_joint

SEED_GATE = 2.0
"""Largest rms error, in squares, of a board predicted from one other board, whose tilt is uncertain."""
REJOIN_GATE = 0.5
"""Largest rms error, in squares, of a board predicted by a joint fit for it to be added to the fit."""
MAX_SEEDS = 300
MAX_ASSIGNMENTS = 20
MAX_SETTLE_ROUNDS = 4
SEARCH_TOLERANCE = 1e-3
"""Relative tolerance of the cost in fits that only decide which boards belong to an assignment."""


@dataclass(frozen=True, eq=False, slots=True)
class Assignment:
    """An assignment of boards with its joint fit.

    Attributes
    ----------
    matches : the boards seen in both images.
    pose : the joint fit, boards in the order of `matches`.
    chi2_of : chi2 of every detection in image 1 and in image 2, at most `chi2_of_leaving_out`.
    """

    matches: tuple[BoardMatch, ...]
    pose: JointPose
    chi2_of: tuple[FloatArray, FloatArray]

    @property
    def chi2(self) -> float:
        return float(self.chi2_of[0].sum() + self.chi2_of[1].sum())

    def differs_from(self, other: Assignment) -> bool:
        """Return whether a detection has another partner or position in the other assignment."""
        return any(
            (mine.index, mine.key) != (its.index, its.key)
            for mine in self.matches
            for its in other.matches
            if mine.index[0] == its.index[0] or mine.index[1] == its.index[1]
        )


Name = frozenset[tuple[tuple[int, int], tuple[int, ...]]]
"""What an assignment assigns: the detections and key of each match."""


def _name(matches: Iterable[BoardMatch]) -> Name:
    return frozenset((match.index, match.key) for match in matches)


def ranked_assignments(pair: ImagePair) -> list[Assignment]:
    """Return distinct assignments with their joint fits, best first; raises DegenerateError if there is none."""
    matches, predictor = pair.matches, _Predictor.build(pair)
    # Whole boards first: a part of a board has many possible positions, most of them wrong.
    open_places = Counter(match.index for match in matches)
    seeds = np.array(sorted(range(len(matches)), key=lambda n: open_places[matches[n].index])[:MAX_SEEDS])
    motions = predictor.cam2_from_board[seeds] @ np.linalg.inv(predictor.cam1_from_board[seeds])
    misses = predictor.misses(motions)
    starts: dict[Name, tuple[float, FloatArray, list[int]]] = {}
    for motion, miss in zip(motions, misses, strict=True):
        chosen = _choose(pair, miss, SEED_GATE)
        if not chosen:
            continue
        total = sum(min(float(miss[n]), SEED_GATE) ** 2 for n in chosen) - SEED_GATE**2 * len(chosen)
        name = _name(matches[n] for n in chosen)
        if name not in starts or total < starts[name][0]:
            starts[name] = (total, motion, chosen)
    if not starts:
        raise DegenerateError(
            "pair: no place of the cameras explains a single board in both images; check the sizes of the squares, and "
            "which calibration belongs to which image"
        )
    found: dict[Name, Assignment] = {}
    for _, motion, chosen in sorted(starts.values(), key=lambda s: s[0])[:MAX_ASSIGNMENTS]:
        assignment = _settle(pair, predictor, motion, chosen)
        name = _name(assignment.matches)
        if name not in found or assignment.chi2 < found[name].chi2:
            found[name] = assignment
    return sorted(found.values(), key=lambda s: s.chi2)


@dataclass(frozen=True, eq=False, slots=True)
class _Predictor:
    """Predicts the outermost corners of each match's second detection from the relative pose."""

    cam1_from_board: FloatArray
    cam2_from_board: FloatArray
    in_cam1: Points
    rays: FloatArray
    bases: FloatArray
    spacing_px: FloatArray

    @classmethod
    def build(cls, pair: ImagePair) -> _Predictor:
        in_cam1, rays, bases, view2 = [], [], [], pair.views[1]
        for match in pair.matches:
            second, cam1_from_board = match.index[1], match.cam_from_board[0]
            outer = _outermost(view2.detections[second])
            in_cam1.append(pair.points(match, 1)[outer] @ cam1_from_board[:3, :3].T + cam1_from_board[:3, 3])
            rays.append(view2.observations[second].rays[outer])
            bases.append(view2.observations[second].bases[outer])
        return cls(
            np.stack([match.cam_from_board[0] for match in pair.matches]),
            np.stack([match.cam_from_board[1] for match in pair.matches]),
            np.stack(in_cam1),
            np.stack(rays),
            np.stack(bases),
            view2.spacing_px[[match.index[1] for match in pair.matches]],
        )

    def misses(self, motions: FloatArray) -> FloatArray:
        """Return the rms errors (S, L), in squares, of the predicted corners of L matches for motions (S, 4, 4)."""
        x = np.einsum("sij,lpj->slpi", motions[:, :3, :3], self.in_cam1) + motions[:, None, None, :3, 3]
        u = x / np.linalg.norm(x, axis=-1, keepdims=True)
        closeness = np.maximum(1.0 + np.einsum("slpi,lpi->slp", u, self.rays), 1e-9)[..., None]
        offset = 2.0 * np.einsum("lpki,slpi->slpk", self.bases, u) / closeness
        return np.asarray(np.sqrt((offset**2).sum(axis=-1).mean(axis=-1)) / self.spacing_px)


def _outermost(detection: BoardDetection) -> IntArray:
    """Return the indices of the corners furthest along the four diagonals of the grid."""
    total, difference = detection.grid.sum(axis=1), detection.grid[:, 0] - detection.grid[:, 1]
    return np.array([np.argmin(total), np.argmax(difference), np.argmax(total), np.argmin(difference)])


def _choose(pair: ImagePair, miss: FloatArray, gate: float) -> list[int]:
    """Return the matches chosen greedily by increasing error: each detection once, no kind more often than listed."""
    chosen: list[int] = []
    taken, used = set[tuple[int, int]](), [0] * len(pair.kinds)
    order = np.argsort(miss, kind="stable")
    for n in order[miss[order] < gate]:
        match = pair.matches[n]
        both = set(enumerate(match.index))
        if both & taken or used[match.kind] == len(pair.kinds[match.kind].boards):
            continue
        taken |= both
        used[match.kind] += 1
        chosen.append(int(n))
    return sorted(chosen)


def _settle(pair: ImagePair, predictor: _Predictor, motion: FloatArray, chosen: list[int]) -> Assignment:
    """Return the assignment after repeatedly refining it, dropping boards that do not fit and adding those that do."""

    def fit(candidates: list[int], start: FloatArray) -> tuple[float, JointPose]:
        """Return the error of the worst board in units of the gate, and the joint fit."""
        some = [pair.matches[n] for n in candidates]
        pose = _fit(pair, start, some, SEARCH_TOLERANCE)
        return _worst(pair, pose, some), pose

    seen: set[tuple[int, ...]] = set()
    for _ in range(MAX_SETTLE_ROUNDS):
        seen.add(tuple(chosen))
        worst, pose = fit(chosen, motion)
        while worst > 1.0 and len(chosen) > 1:
            # A wrong board distorts the fit of all: find it by leaving out each in turn.
            parts = [chosen[:k] + chosen[k + 1 :] for k in range(len(chosen))]
            fits = [fit(part, motion) for part in parts]
            k = min(range(len(parts)), key=lambda k: fits[k][0])
            chosen, (worst, pose) = parts[k], fits[k]
        motion = pose.cam2_from_cam1
        wider = _choose(pair, predictor.misses(motion[None])[0], REJOIN_GATE)
        if len(wider) < len(chosen) or tuple(wider) in seen:
            break
        chosen = wider
    kept = tuple(pair.matches[n] for n in chosen)
    pose = _fit(pair, motion, kept)
    chi2_of = pair.views[0].chi2_of_leaving_out(), pair.views[1].chi2_of_leaving_out()
    for match, own in zip(kept, pose.chi2, strict=True):
        for chi2, index, value in zip(chi2_of, match.index, own, strict=True):
            chi2[index] = min(value, chi2[index])
    return Assignment(kept, pose, chi2_of)


def _fit(pair: ImagePair, motion: FloatArray, matches: Sequence[BoardMatch], tolerance: float = 1e-9) -> JointPose:
    first, second = (
        BoardCorners.stack(
            [view.observations[match.index[v]] for match in matches], [pair.points(match, v) for match in matches]
        )
        for v, view in enumerate(pair.views)
    )
    start = np.stack([match.cam_from_board[0] for match in matches])
    return refine_joint(motion, start, (first, second), tolerance=tolerance)


def _worst(pair: ImagePair, pose: JointPose, matches: Sequence[BoardMatch]) -> float:
    """Return the largest rms distance of a board in one of the images, in units of the gate."""
    gates = [
        np.sqrt(squared / len(view.observations[k].rays)) / view.gate_px[k]
        for match, own in zip(matches, pose.squared_px, strict=True)
        for view, k, squared in zip(pair.views, match.index, own, strict=True)
    ]
    return float(max(gates))
