"""Match the corners of boards that were detected in two images, and estimate directions at them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rigkit.affine.affinities import DirectionNoise
from rigkit.affine.directions import direction_field
from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import board_with_fixed_pupil
from rigkit.cameras.moving_pupil import NearCamera, far_camera
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.choices import Support
from rigkit.core.detections import BoardDetection, common_corners
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import DirectionPairs, Matches
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.printing import brief
from rigkit.core.truth import MeasuredAngle
from rigkit.identification.identify import PairIdentity, identify_pair
from rigkit.identification.placements import board_kinds, placements

Chain = Literal["raw", "rectified"]

MAX_RECTIFIED_RAD = np.deg2rad(75.0)
"""Here a perspective view along the camera's axis stretches a pixel by 1 / cos^2 = 15; beyond, use raw pixels."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class MatchedPair:
    """Two images of the same boards, corner by corner.

    Attributes
    ----------
    pair_id : name of the pair.
    camera1, camera2 : calibrated central cameras of the captured images. If a lens has a moving entrance pupil, its
        corners are corrected by `as_with_fixed_pupil`.
    boards : boards seen in both images, in the order of `matches.board_index`.
    identity : identities of the boards and their corners.
    chain : "raw": `matches` are in captured pixels; "rectified": in perspective views along each camera's axis.
    captured : the corners in captured pixels, where their noise is isotropic.
    matches : the corners in the coordinates of `chain`.
    directions : at the same corners, in the coordinates of `chain`.
    noise : predicted covariance of the directions.
    notes : warnings.
    """

    pair_id: str
    camera1: Camera
    camera2: Camera
    boards: tuple[Board, ...]
    identity: PairIdentity
    chain: Chain
    captured: Matches
    matches: Matches
    directions: DirectionPairs
    noise: DirectionNoise
    notes: tuple[str, ...] = ()

    __repr__ = brief

    def with_scaled_sigmas(self, factor: float) -> MatchedPair:
        """Return the same pair with all standard deviations of corners and directions multiplied by `factor`."""

        def scaled(matches: Matches) -> Matches:
            return replace(matches, sigma1_px=matches.sigma1_px * factor, sigma2_px=matches.sigma2_px * factor)

        noise = DirectionNoise(self.noise.covariance1 * factor**2, self.noise.covariance2 * factor**2)
        return replace(self, captured=scaled(self.captured), matches=scaled(self.matches), noise=noise)

    def in_chain(self, chain: Chain, *, support: Support = "patch") -> MatchedPair:
        """Return the same identified corners in the coordinates of another chain; see `match_pair`."""
        return _matched(self.pair_id, self.camera1, self.camera2, self.boards, self.identity, chain, support, 2)


def match_pair(
    pair_id: str,
    camera1: Camera,
    camera2: Camera,
    detections1: Sequence[BoardDetection],
    detections2: Sequence[BoardDetection],
    boards: Sequence[Board],
    *,
    layout: Mapping[str, str] | None = None,
    angles: Sequence[MeasuredAngle] = (),
    chain: Chain = "raw",
    support: Support = "patch",
    window: int | None = 2,
) -> MatchedPair:
    """Identify the boards, match their corners, and estimate directions.

    Raises InputError if no board is seen in both images; DegenerateError if `chain` is "rectified" and a corner is too
    far off the axis.

    Parameters
    ----------
    pair_id : for messages.
    camera1, camera2 : the cameras; the same object twice if one camera was moved. For a lens with a moving entrance
        pupil (`NearCamera`) the corners are corrected for it, at the distances that the boards' squares give.
    detections1, detections2 : all boards found in each image.
    boards : the boards in the scene.
    layout : board id -> "left", "right", "floor", "ceiling" or "back", if declared.
    angles : measured angles between boards; they identify boards of the same pattern if there is no layout.
    chain : coordinates of the matches.
    support, window : pixels that a direction is estimated from, see `direction_field`.
    """
    _check_sizes(pair_id, (*detections1, *detections2), boards)

    def identified(one: Sequence[BoardDetection], two: Sequence[BoardDetection]) -> PairIdentity:
        return identify_pair(one, two, boards, *lenses, layout=layout, angles=angles)

    lenses = far_camera(camera1), far_camera(camera2)
    identity, notes = identified(detections1, detections2), list[str]()
    if lenses != (camera1, camera2):
        one, note1 = _with_fixed_pupil(identity.detections1, boards, camera1, "image 1")
        two, note2 = _with_fixed_pupil(identity.detections2, boards, camera2, "image 2")
        identity, notes = identified(one, two), [*note1, *note2]
    matched = _matched(pair_id, *lenses, boards, identity, chain, support, window)
    return replace(matched, notes=(*notes, *matched.notes))


def _with_fixed_pupil(
    detections: Sequence[BoardDetection], boards: Sequence[Board], camera: Camera, image: str
) -> tuple[Sequence[BoardDetection], list[str]]:
    """Return identified boards, corrected for a moving entrance pupil, and notes about the correction."""
    if not isinstance(camera, NearCamera):
        return detections, []
    by_id = {board.board_id: board for board in boards}
    out = [
        replace(d, pixels=board_with_fixed_pupil(camera, d.pixels, by_id[str(d.board_id)].points(d.grid)))
        for d in detections
    ]
    largest = max(
        (float(np.abs(new.pixels - old.pixels).max()) for new, old in zip(out, detections, strict=True)), default=0.0
    )
    moves = "the entrance pupil of the lens moves"
    return out, [f"{image}: {moves}; corners were corrected to a central camera, by up to {largest:.1f} px"]


def _matched(
    pair_id: str,
    camera1: Camera,
    camera2: Camera,
    boards: Sequence[Board],
    identity: PairIdentity,
    chain: Chain,
    support: Support,
    window: int | None,
) -> MatchedPair:
    """Match the corners of identified boards, and estimate directions; see `match_pair`."""
    pairs, unseen = _with_rays(identity.pairs(), camera1, camera2)
    if not pairs:
        reasons = "; ".join(f"{name}: {why}" for name, why in identity.missing.items())
        raise InputError(f"pair '{pair_id}': no board is seen in both images ({reasons}); check images and boards")
    by_id = {board.board_id: board for board in boards}
    used = tuple(by_id[str(first.board_id)] for first, _ in pairs)
    captured = _gather(camera1, camera2, pairs)
    view1, view2 = camera1, camera2
    viewed = pairs
    if chain == "rectified":
        view1, view2 = _axis_view(camera1, captured.rays1, pair_id), _axis_view(camera2, captured.rays2, pair_id)
        viewed = tuple((_in_view(a, camera1, view1), _in_view(b, camera2, view2)) for a, b in pairs)
    matches = captured if chain == "raw" else _gather(view1, view2, viewed)
    patterns = [board.pattern for board in used]
    directions, noise = _directions(viewed, patterns, view1, view2, support, window, matches)
    notes = [f"board '{name}': {why}" for name, why in identity.missing.items()]
    notes += [note for pair in identity.pairs() for note in _shown_alike_in_part(*pair, by_id)]
    if unseen:
        notes.append(f"{unseen} corners lie outside the calibrated field of view and were left out")
    return MatchedPair(
        pair_id=pair_id,
        camera1=camera1,
        camera2=camera2,
        boards=used,
        identity=identity,
        chain=chain,
        captured=captured,
        matches=matches,
        directions=directions,
        noise=noise,
        notes=(*notes, *identity.notes),
    )


def _check_sizes(pair_id: str, detections: Sequence[BoardDetection], boards: Sequence[Board]) -> None:
    """Raise InputError if no detection has a declared size and two complete grids have the same size, which no declared
    board has room for.

    A single odd grid may be a part of a larger board. So may two equal ones of a chessboard, covered alike: images show
    whether it ends there (`rigkit.validation.board_ends`).
    """
    declared = {frozenset(board.size) for board in boards}
    sizes = Counter(f"{d.columns}x{d.rows}" for d in detections if d.complete and not _is_part(d, boards))
    if any(frozenset((d.columns, d.rows)) in declared for d in detections) or not sizes:
        return
    size, count = sizes.most_common(1)[0]
    if count >= 2:
        listed = ", ".join(sorted({f"{board.columns}x{board.rows}" for board in boards}))
        raise InputError(
            f"pair '{pair_id}': the boards listed have {listed} inner corners, but {count} complete grids of {size} "
            "were found; correct columns and rows in the board file"
        )


def _shown_alike_in_part(first: BoardDetection, second: BoardDetection, boards: Mapping[str, Board]) -> list[str]:
    """Return a note, if both images show the same whole grid of fewer corners than their board is declared with."""
    board = boards[str(first.board_id)]
    columns, rows = (int(n) for n in np.ptp(first.grid, axis=0) + 1)
    alike = len(common_corners(first, second)[0]) == len(first.grid) == len(second.grid) == columns * rows
    if not alike or (columns, rows) == board.size:
        return []
    return [
        f"board '{board.board_id}': both images show the same {columns}x{rows} of its {board.columns}x{board.rows} "
        "corners: something covers the others, or the board file is wrong"
    ]


def _is_part(detection: BoardDetection, boards: Sequence[Board]) -> bool:
    """Return whether a grid may be a part of one of the chessboards among the `boards`."""
    chessboards = [board for board in boards if isinstance(board.pattern, Chessboard)]
    return any(placements(detection, kind) for kind in board_kinds(chessboards))


def _with_rays(
    pairs: Sequence[tuple[BoardDetection, BoardDetection]], camera1: Camera, camera2: Camera
) -> tuple[tuple[tuple[BoardDetection, BoardDetection], ...], int]:
    """Return the pairs without corners outside their camera's field of view, and the number of such corners."""
    out = []
    dropped = 0
    for pair in pairs:
        kept = []
        for detection, camera in zip(pair, (camera1, camera2), strict=True):
            _, seen = camera.unproject(detection.pixels)
            dropped += int((~seen).sum())
            grid, pixels, sigma_px = detection.grid[seen], detection.pixels[seen], detection.sigma_px[seen]
            kept.append(replace(detection, grid=grid, pixels=pixels, sigma_px=sigma_px))
        out.append((kept[0], kept[1]))
    return tuple(out), dropped


def _gather(camera1: Camera, camera2: Camera, pairs: Sequence[tuple[BoardDetection, BoardDetection]]) -> Matches:
    """Return the corners seen in both images, board after board."""
    common = [(a, b, *common_corners(a, b)) for a, b in pairs]
    return Matches.from_cameras(
        camera1,
        camera2,
        np.concatenate([a.pixels[i] for a, _, _, i, _ in common]),
        np.concatenate([b.pixels[j] for _, b, _, _, j in common]),
        sigma1_px=np.concatenate([a.sigma_px[i] for a, _, _, i, _ in common]),
        sigma2_px=np.concatenate([b.sigma_px[j] for _, b, _, _, j in common]),
        board_index=np.repeat(np.arange(len(pairs)), [len(grid) for _, _, grid, _, _ in common]),
        grid=np.concatenate([grid for _, _, grid, _, _ in common]),
    )


def _directions(
    pairs: Sequence[tuple[BoardDetection, BoardDetection]],
    patterns: Sequence[Pattern],
    view1: Camera,
    view2: Camera,
    support: Support,
    window: int | None,
    matches: Matches,
) -> tuple[DirectionPairs, DirectionNoise]:
    parts = []
    for (first, second), pattern in zip(pairs, patterns, strict=True):
        _, i, j = common_corners(first, second)
        one = direction_field(first, view1, support=support, window=window, pattern=pattern)
        two = direction_field(second, view2, support=support, window=window, pattern=pattern)
        noise = one.covariance[i], two.covariance[j], one.shared[i], two.shared[j]
        parts.append((one.vectors[i], two.vectors[j], one.valid[i] & two.valid[j], *noise))
    vectors1, vectors2, valid, *of_noise = (np.concatenate(part) for part in zip(*parts, strict=True))
    directions = DirectionPairs(
        image1=vectors1, image2=vectors2, valid=valid, pixels1=matches.pixels1, pixels2=matches.pixels2
    )
    return directions, DirectionNoise.of_board(*of_noise)


def _axis_view(camera: Camera, rays: FloatArray, pair_id: str) -> Pinhole:
    """Return the pinhole camera along the camera's axis with its focal length; pixels may be outside of its image."""
    widest = float(np.arccos(np.clip(rays[:, 2].min(), -1.0, 1.0)))
    if widest > MAX_RECTIFIED_RAD:
        raise DegenerateError(
            f"pair '{pair_id}': a corner lies {np.rad2deg(widest):.0f} deg off the axis, too far for a perspective "
            "view; use the raw chain (--chain raw)"
        )
    return Pinhole(camera.size_px, np.array([camera.focal_px, camera.focal_px, *camera.axis_px]))


def _in_view(detection: BoardDetection, camera: Camera, view: Pinhole) -> BoardDetection:
    """Return the detection in a perspective view, with sigmas scaled by the local magnification."""
    rays, _ = camera.unproject(detection.pixels)
    pixels, _, d_pixels_d_point, _ = view.project_with_jacobians(rays)
    if not np.isfinite(pixels).all():
        raise DegenerateError("a corner lies behind the perspective view; use the raw chain (--chain raw)")
    local = d_pixels_d_point @ camera.ray_jacobian(detection.pixels)
    magnification = np.linalg.norm(local, axis=(1, 2)) / np.sqrt(2.0)
    return replace(detection, pixels=pixels, sigma_px=detection.sigma_px * magnification)
