"""Assignment of the boards of image 1 to those of image 2: hypotheses from single boards, extended and refined jointly.

One detection in each image, assumed to be the same board in the same position, determines the relative pose of the
cameras, which predicts all other boards in image 2. Detections that fit their predictions extend the assignment, and a
joint least squares fit of all their corners gives its chi square.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Points
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError
from rigkit.identification.board_matches import BoardMatch, ImageObservations
from rigkit.identification.joint_pose import JointPose, refine_joint
from rigkit.identification.placements import BoardKind

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
    chi2_1, chi2_2 : chi2 of every detection in image 1 and 2, at most `chi2_of_leaving_out`.
    """

    matches: tuple[BoardMatch, ...]
    pose: JointPose
    chi2_1: FloatArray
    chi2_2: FloatArray

    @property
    def chi2(self) -> float:
        return float(self.chi2_1.sum() + self.chi2_2.sum())

    def differs_from(self, other: Assignment) -> bool:
        """Return whether a detection has another partner or position in the other assignment."""
        mine = {("1", s.first): (s.second, s.key) for s in self.matches} | {
            ("2", s.second): s.first for s in self.matches
        }
        return any(
            mine.get(("1", s.first), (s.second, s.key)) != (s.second, s.key)
            or mine.get(("2", s.second), s.first) != s.first
            for s in other.matches
        )


def ranked_assignments(
    matches: Sequence[BoardMatch], view1: ImageObservations, view2: ImageObservations, kinds: Sequence[BoardKind]
) -> list[Assignment]:
    """Return distinct assignments with their joint fits, best first; raises DegenerateError if there is none."""
    predictor = _Predictor.build(matches, view2, kinds)
    # Whole boards first: a part of a board has many possible positions, most of them wrong.
    open_places = Counter((s.first, s.second) for s in matches)
    seeds = np.array(
        sorted(range(len(matches)), key=lambda n: open_places[matches[n].first, matches[n].second])[:MAX_SEEDS]
    )
    motions = predictor.cam2_from_board[seeds] @ np.linalg.inv(predictor.cam1_from_board[seeds])
    misses = predictor.misses(motions)
    starts: dict[frozenset[tuple[int, tuple[int, ...]]], tuple[float, FloatArray, list[int]]] = {}
    for motion, miss in zip(motions, misses, strict=True):
        chosen = _choose(miss, SEED_GATE, matches, kinds)
        if not chosen:
            continue
        total = sum(min(float(miss[n]), SEED_GATE) ** 2 for n in chosen) - SEED_GATE**2 * len(chosen)
        name = frozenset((matches[n].first, (matches[n].second, *matches[n].key)) for n in chosen)
        if name not in starts or total < starts[name][0]:
            starts[name] = (total, motion, chosen)
    if not starts:
        raise DegenerateError(
            "pair: no place of the cameras explains a single board in both images; check the sizes of the squares, and "
            "which calibration belongs to which image"
        )
    found: dict[frozenset[tuple[int, tuple[int, ...]]], Assignment] = {}
    for _, motion, chosen in sorted(starts.values(), key=lambda s: s[0])[:MAX_ASSIGNMENTS]:
        assignment = _settle(motion, chosen, matches, predictor, view1, view2, kinds)
        name = frozenset((s.first, (s.second, *s.key)) for s in assignment.matches)
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
    def build(cls, matches: Sequence[BoardMatch], view2: ImageObservations, kinds: Sequence[BoardKind]) -> _Predictor:
        in_cam1, rays, bases = [], [], []
        for match in matches:
            detection, observation = view2.detections[match.second], view2.observations[match.second]
            outer = _outermost(detection)
            points = kinds[match.kind].board.points(match.placement2.grid_of(detection)[outer])
            in_cam1.append(points @ match.cam1_from_board[:3, :3].T + match.cam1_from_board[:3, 3])
            rays.append(observation.rays[outer])
            bases.append(observation.bases[outer])
        return cls(
            np.stack([s.cam1_from_board for s in matches]),
            np.stack([s.cam2_from_board for s in matches]),
            np.stack(in_cam1),
            np.stack(rays),
            np.stack(bases),
            view2.spacing_px[[s.second for s in matches]],
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


def _choose(miss: FloatArray, gate: float, matches: Sequence[BoardMatch], kinds: Sequence[BoardKind]) -> list[int]:
    """Return the matches chosen greedily by increasing error: each detection once, no kind more often than listed."""
    chosen: list[int] = []
    first, second, used = set(), set(), [0] * len(kinds)
    order = np.argsort(miss, kind="stable")
    for n in order[miss[order] < gate]:
        match = matches[n]
        if match.first in first or match.second in second or used[match.kind] == len(kinds[match.kind].boards):
            continue
        first.add(match.first)
        second.add(match.second)
        used[match.kind] += 1
        chosen.append(int(n))
    return sorted(chosen)


def _settle(
    motion: FloatArray,
    chosen: list[int],
    matches: Sequence[BoardMatch],
    predictor: _Predictor,
    view1: ImageObservations,
    view2: ImageObservations,
    kinds: Sequence[BoardKind],
) -> Assignment:
    """Return the assignment after repeatedly refining it, dropping boards that do not fit and adding those that do."""

    def fit(candidates: list[int], start: FloatArray) -> tuple[float, JointPose]:
        """Return the error of the worst board in units of the gate, and the joint fit."""
        some = [matches[n] for n in candidates]
        pose = _fit(start, some, view1, view2, kinds, SEARCH_TOLERANCE)
        return _worst(pose, some, view1, view2), pose

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
        wider = _choose(predictor.misses(motion[None])[0], REJOIN_GATE, matches, kinds)
        if len(wider) < len(chosen) or tuple(wider) in seen:
            break
        chosen = wider
    kept = tuple(matches[n] for n in chosen)
    pose = _fit(motion, kept, view1, view2, kinds)
    chi2_1, chi2_2 = view1.chi2_of_leaving_out(), view2.chi2_of_leaving_out()
    for match, (one, two) in zip(kept, pose.chi2, strict=True):
        chi2_1[match.first] = min(one, chi2_1[match.first])
        chi2_2[match.second] = min(two, chi2_2[match.second])
    return Assignment(kept, pose, chi2_1, chi2_2)


def _fit(
    motion: FloatArray,
    matches: Sequence[BoardMatch],
    view1: ImageObservations,
    view2: ImageObservations,
    kinds: Sequence[BoardKind],
    tolerance: float = 1e-9,
) -> JointPose:
    return refine_joint(
        motion,
        np.stack([s.cam1_from_board for s in matches]),
        [view1.observations[s.first] for s in matches],
        [kinds[s.kind].board.points(s.placement1.grid_of(view1.detections[s.first])) for s in matches],
        [view2.observations[s.second] for s in matches],
        [kinds[s.kind].board.points(s.placement2.grid_of(view2.detections[s.second])) for s in matches],
        tolerance=tolerance,
    )


def _worst(pose: JointPose, matches: Sequence[BoardMatch], view1: ImageObservations, view2: ImageObservations) -> float:
    """Return the largest rms distance of a board in one of the images, in units of the gate."""
    gates = []
    for match, squared in zip(matches, pose.squared_px, strict=True):
        counts = [len(view1.observations[match.first].rays), len(view2.observations[match.second].rays)]
        gates += [*(np.sqrt(squared / counts) / [view1.gate_px[match.first], view2.gate_px[match.second]])]
    return float(max(gates))
