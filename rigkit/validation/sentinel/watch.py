"""Calibrations as what is watched."""

from __future__ import annotations

from rigkit.calibration.result import Calibration
from rigkit.geometry.rigid3 import Rigid3
from rigkit.validation.sentinel.evidence import Watched


def watched_camera(calibration: Calibration, name: str) -> Watched:
    """Return a camera as it was calibrated."""
    return Watched(
        names=(name,),
        cameras=(calibration.camera,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=calibration.covariance,
        sigma_px=calibration.sigma_px,
        overdispersion=calibration.overdispersion,
        freedom=calibration.freedom,
        boards_mm={shape.board_id: shape.points_mm for shape in calibration.boards},
    )
