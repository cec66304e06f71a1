"""Candidate matches of detections of image 1 with detections of image 2, in all possible positions on a board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, Points
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.board_pose import board_poses, ray_residuals
from rigkit.identification.joint_pose import BoardObservation
from rigkit.identification.placements import BoardKind, Placement, describe, placements, possible_kinds

GATE_SQUARES = 0.1
GATE_PX = 2.0
GATE_SMALL_SQUARES = 0.25
"""Largest rms residual of a board in a joint fit: a tenth of a square; for small squares 2 px, due to noise and
calibration errors, but at most a quarter of a square."""
MIN_OBSERVED_CORNERS = 4
TILT_RMS_RATIO = 3.0
TILT_RMS_PX = 0.5
"""The second pose of a plane is tried too if its rms is at most this multiple of the first one's, or this many px."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class BoardMatch:
    """The hypothesis that a detection of image 1 and one of image 2 are one board of a kind.

    Attributes
    ----------
    index : of both detections.
    key : equal for all placements and poses with the same correspondence of corners.
    placement : grids of both detections to the grid of the board.
    cam_from_board : (4, 4) of both cameras.
    against_colour : whether the two differ by a rotation of 90 degrees that contradicts the colours of the squares, on
        a square board with an odd number of corners per side.
    """

    index: tuple[int, int]
    kind: int
    key: tuple[int, ...]
    placement: tuple[Placement, Placement]
    cam_from_board: tuple[FloatArray, FloatArray]
    against_colour: bool


@dataclass(frozen=True, eq=False, slots=True)
class ImageObservations:
    """The detections of one image with their rays and possible kinds.

    Attributes
    ----------
    detections : without ids that are not listed and corners without a ray.
    observations, spacing_px, kinds : per detection: rays, distance of neighbouring corners, possible kinds.
    notes : on corners that were left out.
    """

    camera: Camera
    detections: tuple[BoardDetection, ...]
    observations: tuple[BoardObservation, ...]
    spacing_px: FloatArray
    kinds: list[list[int]]
    notes: tuple[str, ...]

    @classmethod
    def of(
        cls, detections: Sequence[BoardDetection], kinds: Sequence[BoardKind], camera: Camera, image: str
    ) -> ImageObservations:
        """Build for the detections of `image` (its name in messages); raises InputError if an id occurs twice."""
        listed = {board_id for kind in kinds for board_id in kind.ids}
        kept: list[BoardDetection] = []
        notes = []
        for found in detections:
            name = found.board_id if found.board_id in listed else None
            if name is not None and any(name == d.board_id for d in kept):
                raise InputError(f"{image}: two detections are called '{name}'; name each board once")
            _, seen = camera.unproject(found.pixels)
            if not seen.all():
                notes.append(
                    f"{image}: {int((~seen).sum())} corners of {describe(found)} lie outside the camera's calibrated "
                    "field of view: left out"
                )
            part = BoardDetection(
                name, found.columns, found.rows, found.grid[seen], found.pixels[seen], found.sigma_px[seen]
            )
            if len(part.grid) >= MIN_OBSERVED_CORNERS:
                kept.append(part)
        observations = tuple(BoardObservation.of(camera, d.pixels, d.sigma_px, image) for d in kept)
        spacing = np.array([_spacing(d) for d in kept])
        return cls(camera, tuple(kept), observations, spacing, possible_kinds(kept, kinds), tuple(notes))

    @property
    def gate_px(self) -> FloatArray:
        """Largest rms residual (D,), px, of each detection in a joint fit."""
        small = np.minimum(GATE_PX, GATE_SMALL_SQUARES * self.spacing_px)
        return np.asarray(np.maximum(GATE_SQUARES * self.spacing_px, small))

    def chi2_of_leaving_out(self) -> FloatArray:
        """Return the chi2 (D,) of each detection with all residuals at the gate: the cost of leaving it out."""
        both = zip(self.gate_px, self.observations, strict=True)
        return np.array([((gate / observation.sigma_px) ** 2).sum() for gate, observation in both])


def _spacing(detection: BoardDetection) -> float:
    """Return the smaller of the median distances between neighbours along rows and columns, px."""
    lattice = detection.lattice()
    steps = [np.linalg.norm(np.diff(lattice, axis=a), axis=-1).ravel() for a in (0, 1)]
    medians = [float(np.median(s[np.isfinite(s)])) for s in steps if np.isfinite(s).any()]
    return min(medians) if medians else float(np.ptp(detection.pixels, axis=0).max())


Tilts: TypeAlias = list[tuple[FloatArray, float]]
"""[(cam_from_grid (4, 4), chi2)] of the plausible poses of a plane, best first; empty if degenerate."""


class GridPoses:
    """Cached poses of detections: in the frame of their own grid for boards of even steps, where it is the same for all
    shifts, else in that of the board."""

    def __init__(self, view: ImageObservations) -> None:
        self.view = view
        self.known: dict[tuple[int, tuple[float, float] | tuple[str, Placement]], Tilts] = {}

    def placed(self, index: int, kind: BoardKind, placement: Placement) -> Tilts:
        """Return [(cam_from_board (4, 4), chi2)] of a detection placed on a board."""
        board, detection = kind.board, self.view.detections[index]
        if not board.pattern.even_steps:
            name = (index, (board.board_id, placement))
            if name not in self.known:
                self.known[name] = self._tilts(index, board.points(placement.grid_of(detection)))
            return self.known[name]
        x_mm, y_mm = board.squares_mm
        steps = (x_mm, y_mm) if placement.quarter_turns % 2 == 0 else (y_mm, x_mm)
        if (index, steps) not in self.known:
            points = np.column_stack([detection.grid * steps, np.zeros(len(detection.grid))])
            self.known[index, steps] = self._tilts(index, points)
        grid_from_board = np.linalg.inv(placement.board_from_grid(detection, board))
        return [(pose @ grid_from_board, chi2) for pose, chi2 in self.known[index, steps]]

    def best_chi2(self) -> FloatArray:
        """Return the smallest chi2 (D,) of each detection among the known poses, NaN without one."""
        best = np.full(len(self.view.detections), np.nan)
        for (index, _), found in self.known.items():
            for _, chi2 in found:
                best[index] = np.fmin(best[index], chi2)
        return best

    def _tilts(self, index: int, points: Points) -> Tilts:
        """Return the poses of a detection with its corners at `points` (N, 3) mm."""
        observation = self.view.observations[index]
        try:
            found = board_poses(observation.rays, points, observation.sigma_px, bases=observation.bases)
        except DegenerateError:
            found = ()
        limit = max(TILT_RMS_RATIO * found[0].rms_rad, TILT_RMS_PX) if found else 0.0
        out = []
        for pose in (p for p in found if p.rms_rad <= limit):
            rigid = pose.cam_from_board
            residual, _ = ray_residuals(
                observation.rays, observation.bases, points, rigid.rotation, rigid.translation_mm
            )
            out.append((rigid.matrix(), float(((residual / observation.sigma_px[:, None]) ** 2).sum())))
        return out


@dataclass(frozen=True, eq=False, slots=True)
class ImagePair:
    """Two images of some boards.

    Attributes
    ----------
    views : the detections of both images.
    kinds : of the boards that may be visible.
    matches : all candidate matches.
    free : chi2 (D,) of each detection's own best pose, in both images; NaN without one.
    """

    views: tuple[ImageObservations, ImageObservations]
    kinds: Sequence[BoardKind]
    matches: Sequence[BoardMatch]
    free: tuple[FloatArray, FloatArray]

    @classmethod
    def of(
        cls,
        detections: tuple[Sequence[BoardDetection], Sequence[BoardDetection]],
        kinds: Sequence[BoardKind],
        cameras: tuple[Camera, Camera],
    ) -> ImagePair:
        """Build with all candidate matches; raises InputError if an id occurs twice in an image."""
        view1, view2 = (
            ImageObservations.of(own, kinds, camera, image)
            for own, camera, image in zip(detections, cameras, ("image 1", "image 2"), strict=True)
        )
        poses1, poses2 = GridPoses(view1), GridPoses(view2)
        matches: list[BoardMatch] = []
        for i, detection1 in enumerate(view1.detections):
            for j, detection2 in enumerate(view2.detections):
                if len({detection1.board_id, detection2.board_id} - {None}) > 1:
                    continue
                for k in sorted(set(view1.kinds[i]) & set(view2.kinds[j])):
                    matches += _matches_of_pair(i, j, k, kinds[k], poses1, poses2)
        return cls((view1, view2), kinds, matches, (poses1.best_chi2(), poses2.best_chi2()))

    def points(self, match: BoardMatch, v: int) -> Points:
        """Return the corners that image `v` (0 or 1) shows of a match, (N, 3) mm in the frame of the board."""
        detection = self.views[v].detections[match.index[v]]
        return self.kinds[match.kind].board.points(match.placement[v].grid_of(detection))


def _matches_of_pair(i: int, j: int, k: int, kind: BoardKind, poses1: GridPoses, poses2: GridPoses) -> list[BoardMatch]:
    detection1, detection2 = poses1.view.detections[i], poses2.view.detections[j]
    square = kind.board.columns == kind.board.rows and detection1.complete and detection2.complete
    matches: list[BoardMatch] = []
    keys = set()
    for placement1 in placements(detection1, kind):
        for placement2 in placements(detection2, kind):
            key = (k, *placement2.relative_to(placement1, detection1, detection2))
            if key in keys:
                continue
            keys.add(key)
            odd = (placement1.quarter_turns + placement2.quarter_turns) % 2 == 1
            against = square and kind.board.columns % 2 == 1 and odd
            matches += [
                BoardMatch(
                    index=(i, j),
                    kind=k,
                    key=key,
                    placement=(placement1, placement2),
                    cam_from_board=(pose1, pose2),
                    against_colour=against,
                )
                for pose1, _ in poses1.placed(i, kind, placement1)
                for pose2, _ in poses2.placed(j, kind, placement2)
            ]
    return matches
