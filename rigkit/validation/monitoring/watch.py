"""Calibrations of cameras and rigs as `Monitored`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.departures import with_own_noise
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.pupil import SolvedPupil
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.mounted import MountedCameras
from rigkit.cameras.moving_pupil import PUPIL_TERMS, NearCamera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import FloatArray, IntArray, scaled_pinv
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.information import Knowledge
from rigkit.validation.monitoring.evidence import Monitored


def monitored_camera(
    calibration: Calibration, name: str, *, beyond_model: bool = True, quoted: bool = False
) -> Monitored:
    """Return a calibrated camera, by default with the inadequacy of its model and the warps of its boards among the
    unknowns; a moving pupil has its covariance from the solution. `quoted` is as for `uncertain_camera`."""
    known = (
        uncertain_camera(calibration, quoted=quoted, near=True)
        if beyond_model
        else UncertainCamera(calibration.near, calibration.near_covariance[:-6, :-6])
    )
    own = with_own_noise(calibration) if beyond_model else calibration
    camera = Monitored(
        names=(name,),
        cameras=(known.camera,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=known.covariance,
        expected=known.expected,
        sigma_px=own.sigma_px,
        overdispersion=own.overdispersion,
        freedom=calibration.freedom,
        boards_mm={shape.board_id: shape.points_mm for shape in calibration.boards},
    )
    return _with_warps(camera, Knowledge.of(own), own.widening if quoted else 1.0) if beyond_model else camera


def _with_warps(camera: Monitored, known: Knowledge, widening: float) -> Monitored:
    """Return a camera with the warps of its boards, as `known` with the model's P parameters from the same views; their
    standard deviations are multiplied by `widening`.

    The covariance of the warps w given the parameters x is I_ww^-1, and w follows x by -I_ww^-1 I_wx: where a board's
    aspect ratio and that of the pixels were not told apart, they are wrong together.
    """
    p = known.camera.parameters.size
    if not known.warped:
        return camera
    rest = scaled_pinv(known.information[p:, p:])
    follows = np.zeros((len(rest), len(camera.covariance)))
    follows[:, :p] = -rest @ known.information[p:, :p]
    through = np.concatenate([np.eye(len(camera.covariance)), follows])
    covariance, expected = (through @ part @ through.T for part in (camera.covariance, camera.mean_products))
    covariance[-len(rest) :, -len(rest) :] += widening**2 * rest
    return replace(camera, covariance=covariance, expected=expected, warped=known.warped)


def monitored_rig(rig: MountedCameras) -> Monitored:
    """Return a rig, with the inadequacies of its models among the parameters; raises InputError without covariance."""
    whole = rig.with_departures
    if whole.covariance is None or rig.sigma_px is None:
        raise InputError("the rig has no covariance; calibrate it with rigkit")
    central = Monitored(
        names=tuple(rig.cameras),
        cameras=whole.lenses,
        cam_from_rig=rig.poses,
        covariance=whole.covariance,
        expected=whole.expected,
        sigma_px=rig.sigma_px,
        overdispersion=rig.overdispersion,
        freedom=rig.freedom,
        scale_sigma=rig.scale_sigma,
    )
    return _with_moving_pupils(central, rig.pupils)


def _with_moving_pupils(central: Monitored, pupils: Mapping[str, SolvedPupil]) -> Monitored:
    """Return cameras with their moving pupils, by name, and the covariance of all parameters.

    A pupil e depends on the lenses and mounts x by their joint covariance, e = W x + rest; the rests of two pupils are
    assumed independent.
    """
    if not pupils:
        return central
    models, layout, order = central.of_models, central.layout, list[IntArray]()
    follows, rest = [np.eye(layout.count)], [np.zeros((layout.count, layout.count))]
    inverse = scaled_pinv(central.covariance[np.ix_(models, models)])
    cameras = list(central.cameras)
    for k, (name, run) in enumerate(zip(central.names, layout.cameras, strict=True)):
        order.append(np.arange(run.start, run.stop))
        if name in pupils:
            order.append(sum(len(rows) for rows in follows) + np.arange(PUPIL_TERMS))
            by = np.zeros((PUPIL_TERMS, layout.count))
            by[:, models] = pupils[name].with_frame.T @ inverse
            follows.append(by)
            rest.append(pupils[name].covariance - by[:, models] @ pupils[name].with_frame)
            cameras[k] = NearCamera.of(cameras[k], pupils[name].terms)
    order.append(np.arange(layout.cameras[-1].stop, layout.count))
    through, at = np.concatenate(follows), np.concatenate(order)
    covariance, expected = (through @ part @ through.T for part in (central.covariance, central.mean_products))
    covariance += _blocks(rest)
    return replace(
        central,
        cameras=tuple(cameras),
        covariance=covariance[np.ix_(at, at)],
        expected=expected[np.ix_(at, at)],
    )


def _blocks(parts: list[FloatArray]) -> FloatArray:
    """Return the block-diagonal matrix of the parts."""
    # Imported here: scipy.linalg is slow to import, and few lenses need it.
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*parts))
