"""Calibrations as what is watched."""

from __future__ import annotations

from rigkit.calibration.displaced import uncertain_camera
from rigkit.calibration.result import Calibration
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.geometry.rigid3 import Rigid3
from rigkit.validation.sentinel.evidence import Watched


def watched_camera(calibration: Calibration, name: str, *, beyond_model: bool = True) -> Watched:
    """Return a camera as it was calibrated, by default with what its lens may do beyond its model."""
    known = (
        uncertain_camera(calibration, quoted=False)
        if beyond_model
        else UncertainCamera(calibration.camera, calibration.covariance)
    )
    return Watched(
        names=(name,),
        cameras=(known.camera,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=known.covariance,
        sigma_px=calibration.sigma_px,
        overdispersion=calibration.overdispersion,
        freedom=calibration.freedom,
        boards_mm={shape.board_id: shape.points_mm for shape in calibration.boards},
    )
