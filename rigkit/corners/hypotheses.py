"""Which board of image 1 is which board of image 2: hypotheses from single boards, completed and refined jointly.

One detection in either image, taken for the same board in the same position, fixes the relative pose of the cameras; it
predicts all other boards in image 2. The detections that agree complete the assignment, and a joint least squares over
all their corners scores it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.arrays import FloatArray, IntArray, Points
from rigkit.cameras.base import Camera
from rigkit.corners.candidates import BoardKind, Placement, placements, possible_kinds
from rigkit.corners.joint_pose import JointPose, Sight, refine_joint
from rigkit.detections import BoardDetection
from rigkit.errors import DegenerateError
from rigkit.geometry.board_pose import board_poses, ray_residuals

__all__ = ["GridPoses", "Link", "Solution", "View", "links_between", "solutions"]

SEED_GATE = 2.0
"""Squares by which a board may miss the prediction from one other board: its tilt is uncertain, its lever long."""
JOINT_GATE = 0.25
"""Squares by which a board may miss the joint fit and still count as seen there."""
REJOIN_GATE = 0.5
"""Squares by which a board may miss the prediction of a joint fit to be tried as part of it."""
MAX_SEEDS = 300
MAX_SOLUTIONS = 20
MAX_ROUNDS = 4
TILT_RMS_RATIO = 3.0
TILT_RMS_PX = 0.5
"""The reversed tilt of a board is tried too where its rms is within this ratio, or this many px, of the better one."""


@dataclass(frozen=True, eq=False, slots=True)
class Link:
    """Detection `first` of image 1 and `second` of image 2 taken for one board of a kind.

    Attributes
    ----------
    key : what is claimed: equal for all placements (and tilts) that say the same of the two images.
    placement1, placement2 : grids of the detections to the grid of the board.
    cam1_from_board, cam2_from_board : (4, 4)
    against_colour : whether the two are turned by 90 degrees against each other although the colours of a square board
        should have prevented that.
    """

    first: int
    second: int
    kind: int
    key: tuple[int, ...]
    placement1: Placement
    placement2: Placement
    cam1_from_board: FloatArray
    cam2_from_board: FloatArray
    against_colour: bool


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """The detections of one image with all that does not depend on the other image."""

    camera: Camera
    detections: tuple[BoardDetection, ...]
    sights: tuple[Sight, ...]
    spacing_px: FloatArray
    kinds: list[list[int]]

    @classmethod
    def of(cls, detections: Sequence[BoardDetection], kinds: Sequence[BoardKind], camera: Camera, image: str) -> View:
        sights = tuple(Sight.of(camera, d.pixels, d.sigma_px, image) for d in detections)
        spacing = np.array([_spacing(d) for d in detections])
        return cls(camera, tuple(detections), sights, spacing, possible_kinds(detections, kinds))

    def give_up(self) -> FloatArray:
        """Return the chi2 (D,) of each detection when all its corners miss by `JOINT_GATE` squares."""
        return np.array(
            [
                ((JOINT_GATE * spacing / sight.sigma_px) ** 2).sum()
                for spacing, sight in zip(self.spacing_px, self.sights, strict=True)
            ]
        )


@dataclass(frozen=True, eq=False, slots=True)
class Solution:
    """A whole assignment with its joint fit.

    Attributes
    ----------
    links : the boards taken to be seen in both images.
    pose : the joint fit, boards in the order of `links`.
    chi2_1, chi2_2 : chi2 of every detection in image 1 and 2, at most that of giving it up.
    """

    links: tuple[Link, ...]
    pose: JointPose
    chi2_1: FloatArray
    chi2_2: FloatArray

    @property
    def chi2(self) -> float:
        return float(self.chi2_1.sum() + self.chi2_2.sum())

    def differs_from(self, other: Solution) -> bool:
        """Say whether the two contradict each other: one detection, but another partner or position."""
        mine = {("1", s.first): (s.second, s.key) for s in self.links} | {("2", s.second): s.first for s in self.links}
        return any(
            mine.get(("1", s.first), (s.second, s.key)) != (s.second, s.key)
            or mine.get(("2", s.second), s.first) != s.first
            for s in other.links
        )


def _spacing(detection: BoardDetection) -> float:
    """Return the smaller of the median distances between neighbours along rows and columns, px."""
    lattice = detection.lattice()
    steps = [np.linalg.norm(np.diff(lattice, axis=a), axis=-1).ravel() for a in (0, 1)]
    medians = [float(np.median(s[np.isfinite(s)])) for s in steps if np.isfinite(s).any()]
    return min(medians) if medians else float(np.ptp(detection.pixels, axis=0).max())


class GridPoses:
    """Poses of detections in the frame of their own grid, each computed once."""

    def __init__(self, view: View) -> None:
        self.view = view
        self.known: dict[tuple[int, float, float], list[tuple[FloatArray, float]]] = {}

    def of(self, index: int, step_x_mm: float, step_y_mm: float) -> list[tuple[FloatArray, float]]:
        """Return [(cam_from_grid (4, 4), chi2)] of the plausible tilts, best first; none where degenerate."""
        name = (index, step_x_mm, step_y_mm)
        if name not in self.known:
            detection, sight = self.view.detections[index], self.view.sights[index]
            points = np.column_stack([detection.grid * [step_x_mm, step_y_mm], np.zeros(len(detection.grid))])
            try:
                found = board_poses(sight.rays, points, sight.sigma_px, bases=sight.bases)
            except DegenerateError:
                found = ()
            limit = max(TILT_RMS_RATIO * found[0].rms_rad, TILT_RMS_PX) if found else 0.0
            self.known[name] = []
            for pose in (p for p in found if p.rms_rad <= limit):
                rigid = pose.cam_from_board
                residual, _ = ray_residuals(sight.rays, sight.bases, points, rigid.rotation, rigid.translation_mm)
                chi2 = float(((residual / sight.sigma_px[:, None]) ** 2).sum())
                self.known[name].append((rigid.matrix(), chi2))
        return self.known[name]

    def placed(self, index: int, kind: BoardKind, placement: Placement) -> list[tuple[FloatArray, float]]:
        """Return [(cam_from_board (4, 4), chi2)] of a detection placed on a board."""
        board = kind.board
        steps = (board.square_x_mm, board.square_y_mm)
        steps = steps if placement.quarter_turns % 2 == 0 else steps[::-1]
        grid_from_board = np.linalg.inv(placement.board_from_grid(self.view.detections[index], board))
        return [(pose @ grid_from_board, chi2) for pose, chi2 in self.of(index, *steps)]


def links_between(view1: View, view2: View, kinds: Sequence[BoardKind]) -> tuple[list[Link], FloatArray, FloatArray]:
    """Return all links, and the free chi2 of each detection (its own pose, its best kind; NaN where it has none)."""
    poses1, poses2 = GridPoses(view1), GridPoses(view2)
    links: list[Link] = []
    for i, detection1 in enumerate(view1.detections):
        for j, detection2 in enumerate(view2.detections):
            names = {detection1.board_id, detection2.board_id} - {None}
            known = {board_id for kind in kinds for board_id in kind.ids}
            if len(names & known) > 1:
                continue
            for k in sorted(set(view1.kinds[i]) & set(view2.kinds[j])):
                links += _links_of_pair(i, j, k, kinds[k], poses1, poses2)
    free = []
    for view, poses in ((view1, poses1), (view2, poses2)):
        best = np.full(len(view.detections), np.nan)
        for (index, _, _), found in poses.known.items():
            for _, chi2 in found:
                best[index] = np.fmin(best[index], chi2)
        free.append(best)
    return links, free[0], free[1]


def _links_of_pair(i: int, j: int, k: int, kind: BoardKind, poses1: GridPoses, poses2: GridPoses) -> list[Link]:
    detection1, detection2 = poses1.view.detections[i], poses2.view.detections[j]
    square = kind.board.columns == kind.board.rows and detection1.complete and detection2.complete
    links, keys = [], set()
    for placement1 in placements(detection1, kind):
        for placement2 in placements(detection2, kind):
            key = (k, *placement2.relative_to(placement1, detection1, detection2))
            if key in keys:
                continue
            keys.add(key)
            odd = (placement1.quarter_turns + placement2.quarter_turns) % 2 == 1
            against = square and kind.board.columns % 2 == 0 and odd
            for pose1, _ in poses1.placed(i, kind, placement1):
                for pose2, _ in poses2.placed(j, kind, placement2):
                    links.append(Link(i, j, k, key, placement1, placement2, pose1, pose2, against))
    return links


def solutions(links: Sequence[Link], view1: View, view2: View, kinds: Sequence[BoardKind]) -> list[Solution]:
    """Return distinct assignments with their joint fits, best first."""
    predictor = _Predictor.build(links, view2, kinds)
    # Whole boards first: a part whose place on the board is open makes many links, most of them wrong.
    open_places = Counter((s.first, s.second) for s in links)
    seeds = np.array(sorted(range(len(links)), key=lambda n: open_places[links[n].first, links[n].second])[:MAX_SEEDS])
    motions = predictor.cam2_from_board[seeds] @ np.linalg.inv(predictor.cam1_from_board[seeds])
    misses = predictor.misses(motions)
    starts: dict[frozenset[tuple[int, tuple[int, ...]]], tuple[float, FloatArray, list[int]]] = {}
    for motion, miss in zip(motions, misses, strict=True):
        chosen = _choose(miss, SEED_GATE, links, kinds)
        total = sum(min(float(miss[n]), SEED_GATE) ** 2 for n in chosen) - SEED_GATE**2 * len(chosen)
        name = frozenset((links[n].first, (links[n].second, *links[n].key)) for n in chosen)
        if name not in starts or total < starts[name][0]:
            starts[name] = (total, motion, chosen)
    found: dict[frozenset[tuple[int, tuple[int, ...]]], Solution] = {}
    for _, motion, chosen in sorted(starts.values(), key=lambda s: s[0])[:MAX_SOLUTIONS]:
        solution = _settle(motion, chosen, links, predictor, view1, view2, kinds)
        name = frozenset((s.first, (s.second, *s.key)) for s in solution.links)
        if name not in found or solution.chi2 < found[name].chi2:
            found[name] = solution
    return sorted(found.values(), key=lambda s: s.chi2)


@dataclass(frozen=True, eq=False, slots=True)
class _Predictor:
    """Where the outermost corners of each link's second detection are predicted, given the relative pose."""

    cam1_from_board: FloatArray
    cam2_from_board: FloatArray
    in_cam1: Points
    rays: FloatArray
    bases: FloatArray
    spacing_px: FloatArray

    @classmethod
    def build(cls, links: Sequence[Link], view2: View, kinds: Sequence[BoardKind]) -> _Predictor:
        in_cam1, rays, bases = [], [], []
        for link in links:
            detection, sight = view2.detections[link.second], view2.sights[link.second]
            outer = _outermost(detection)
            points = kinds[link.kind].board.points(link.placement2.grid_of(detection)[outer])
            in_cam1.append(points @ link.cam1_from_board[:3, :3].T + link.cam1_from_board[:3, 3])
            rays.append(sight.rays[outer])
            bases.append(sight.bases[outer])
        return cls(
            np.stack([s.cam1_from_board for s in links]),
            np.stack([s.cam2_from_board for s in links]),
            np.stack(in_cam1),
            np.stack(rays),
            np.stack(bases),
            view2.spacing_px[[s.second for s in links]],
        )

    def misses(self, motions: FloatArray) -> FloatArray:
        """Return the rms distance (S, L) of predicted from seen corners in squares, for each motion (S, 4, 4)."""
        x = np.einsum("sij,lpj->slpi", motions[:, :3, :3], self.in_cam1) + motions[:, None, None, :3, 3]
        u = x / np.linalg.norm(x, axis=-1, keepdims=True)
        closeness = np.maximum(1.0 + np.einsum("slpi,lpi->slp", u, self.rays), 1e-9)[..., None]
        offset = 2.0 * np.einsum("lpki,slpi->slpk", self.bases, u) / closeness
        return np.asarray(np.sqrt((offset**2).sum(axis=-1).mean(axis=-1)) / self.spacing_px)


def _outermost(detection: BoardDetection) -> IntArray:
    """Return the indices of the corners furthest along the four diagonals of the grid."""
    total, difference = detection.grid.sum(axis=1), detection.grid[:, 0] - detection.grid[:, 1]
    return np.array([np.argmin(total), np.argmax(difference), np.argmax(total), np.argmin(difference)])


def _choose(miss: FloatArray, gate: float, links: Sequence[Link], kinds: Sequence[BoardKind]) -> list[int]:
    """Return the links taken greedily by rising miss: each detection once, no kind more often than it has boards."""
    chosen: list[int] = []
    first, second, used = set(), set(), [0] * len(kinds)
    order = np.argsort(miss, kind="stable")
    for n in order[miss[order] < gate]:
        link = links[n]
        if link.first in first or link.second in second or used[link.kind] == len(kinds[link.kind].boards):
            continue
        first.add(link.first)
        second.add(link.second)
        used[link.kind] += 1
        chosen.append(int(n))
    return sorted(chosen)


def _settle(
    motion: FloatArray,
    chosen: list[int],
    links: Sequence[Link],
    predictor: _Predictor,
    view1: View,
    view2: View,
    kinds: Sequence[BoardKind],
) -> Solution:
    """Refine an assignment, drop boards that do not fit, add those that then do, until nothing changes."""
    seen: set[tuple[int, ...]] = set()
    while True:
        seen.add(tuple(chosen))
        pose = _fit(motion, [links[n] for n in chosen], view1, view2, kinds)
        miss = _joint_miss(pose, [links[n] for n in chosen], view1, view2)
        if miss.max() > JOINT_GATE and len(chosen) > 1:
            worst = int(np.argmax(miss))
            chosen, motion = [n for k, n in enumerate(chosen) if k != worst], pose.cam2_from_cam1
            continue
        motion = pose.cam2_from_cam1
        wider = _choose(predictor.misses(motion[None])[0], REJOIN_GATE, links, kinds)
        if len(wider) < len(chosen) or tuple(wider) in seen or len(seen) > MAX_ROUNDS * (1 + len(view1.detections)):
            break
        chosen = wider
    kept = tuple(links[n] for n in chosen)
    chi2_1, chi2_2 = view1.give_up(), view2.give_up()
    for link, (one, two) in zip(kept, pose.chi2, strict=True):
        chi2_1[link.first] = min(one, chi2_1[link.first])
        chi2_2[link.second] = min(two, chi2_2[link.second])
    return Solution(kept, pose, chi2_1, chi2_2)


def _fit(motion: FloatArray, links: Sequence[Link], view1: View, view2: View, kinds: Sequence[BoardKind]) -> JointPose:
    return refine_joint(
        motion,
        np.stack([s.cam1_from_board for s in links]),
        [view1.sights[s.first] for s in links],
        [kinds[s.kind].board.points(s.placement1.grid_of(view1.detections[s.first])) for s in links],
        [view2.sights[s.second] for s in links],
        [kinds[s.kind].board.points(s.placement2.grid_of(view2.detections[s.second])) for s in links],
    )


def _joint_miss(pose: JointPose, links: Sequence[Link], view1: View, view2: View) -> FloatArray:
    """Return the larger rms distance of each board in the two images, in squares."""
    squares = []
    for link, (one, two) in zip(links, pose.squared_px, strict=True):
        rms1 = np.sqrt(one / len(view1.sights[link.first].rays)) / view1.spacing_px[link.first]
        rms2 = np.sqrt(two / len(view2.sights[link.second].rays)) / view2.spacing_px[link.second]
        squares.append(max(rms1, rms2))
    return np.array(squares)
