"""What identifying the boards of a pair of images found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rigkit.core.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PairIdentity:
    """Boards of two images, named and turned so that one physical corner has one grid index in both.

    Attributes
    ----------
    detections1, detections2 : the boards of either image that are known; those seen in both come first, in the order
        of the boards listed, the same board at the same place in both; then those seen in that image only.
    cam2_from_cam1 : relative pose, metric, refined over all corners of the boards seen in both images.
    cam1_from_board : pose of every named board, from both images where both see it.
    residual_px : rms distance (2-D per corner, both images) of the corners from the rigid scene of the winner.
    ambiguous : whether geometry alone cannot tell the winner from another assignment; the one with the smallest roll
        between the cameras was then taken, and `notes` says so.
    missing : why a listed board is not in both lists, by board id.
    notes : what was assumed or left out, in words.
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
