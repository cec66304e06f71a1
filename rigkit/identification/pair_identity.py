"""Result of identifying the boards of a pair of images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rigkit.core.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PairIdentity:
    """Boards of two images, with ids and orientations such that a corner has the same grid index in both.

    Attributes
    ----------
    detections1, detections2 : the identified boards of each image: first those seen in both, in the same order, that of
        the boards listed; then those seen in that image only.
    cam2_from_cam1 : metric relative pose, refined over all corners of the boards seen in both images.
    cam1_from_board : pose of every identified board, from both images if both see it.
    residual_px : rms reprojection error (2-D per corner, both images).
    ambiguous : whether geometry alone does not distinguish the result from another assignment; it is then the one with
        the smallest roll between the cameras, and `notes` says so.
    missing : why a listed board is not in both lists, by board id.
    notes : assumptions, and detections or corners that were left out, in words.
    """

    detections1: tuple[BoardDetection, ...]
    detections2: tuple[BoardDetection, ...]
    cam2_from_cam1: Rigid3
    cam1_from_board: Mapping[str, Rigid3]
    residual_px: float
    ambiguous: bool
    missing: Mapping[str, str]
    notes: tuple[str, ...] = ()

    def pairs(self) -> tuple[tuple[BoardDetection, BoardDetection], ...]:
        """Return (detection in image 1, detection in image 2) of every board seen in both."""
        second = {d.board_id: d for d in self.detections2}
        return tuple((d, second[d.board_id]) for d in self.detections1 if d.board_id in second)
