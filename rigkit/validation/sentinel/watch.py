"""Calibrations as what is watched."""

from __future__ import annotations

from rigkit.calibration.displaced import uncertain_camera
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.result import RigCalibration
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
        pupils={} if calibration.pupil is None else {0: calibration.pupil.terms},
    )


def watched_rig(rig: RigCalibration) -> Watched:
    """Return a rig as it was calibrated, with what its lenses may do beyond their models."""
    cameras, covariance = rig.with_departures
    return Watched(
        names=tuple(c.name for c in rig.cameras),
        cameras=cameras,
        cam_from_rig=tuple(c.cam_from_rig for c in rig.cameras),
        covariance=covariance,
        sigma_px=rig.sigma_px,
        overdispersion=rig.overdispersion,
        freedom=rig.freedom,
        scale_sigma=rig.scale_sigma,
        pupils={k: rig.pupils[c.name].terms for k, c in enumerate(rig.cameras) if c.name in rig.pupils},
    )
