"""Poses by other programs, with options equivalent to ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from core_speed.scenes import CAMERA, POSE
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import unit


def opencv_robust(m: Matches) -> Rigid3:
    E21, mask = cv2.findEssentialMat(
        m.pixels1, m.pixels2, CAMERA.K, method=cv2.USAC_MAGSAC, prob=0.999, threshold=3.0 * m.sigma1_px[0]
    )
    _, R, t, _ = cv2.recoverPose(E21, m.pixels1, m.pixels2, CAMERA.K, mask=mask)
    return Rigid3(R, t[:, 0])


def colmap_robust(m: Matches) -> Rigid3 | None:
    pycolmap = optional("pycolmap")
    if pycolmap is None:
        return None
    fx, fy, cx, cy = CAMERA.parameters
    # COLMAP puts (0.5, 0.5) at the centre of the first pixel.
    size = dict(zip(("width", "height"), CAMERA.size_px, strict=True))
    camera = pycolmap.Camera(model="PINHOLE", params=[fx, fy, cx + 0.5, cy + 0.5], **size)
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = 0
    options.ransac.max_error = 3.0 * m.sigma1_px[0]
    pairs = np.repeat(np.arange(len(m), dtype=np.uint32)[:, None], 2, axis=1)
    found = pycolmap.estimate_calibrated_two_view_geometry(
        camera, m.pixels1 + 0.5, camera, m.pixels2 + 0.5, pairs, options
    )
    return Rigid3.from_matrix(found.cam2_from_cam1.matrix())


def poselib_robust(m: Matches) -> Rigid3 | None:
    poselib = optional("poselib")
    if poselib is None:
        return None
    options = {"max_epipolar_error": 3.0 * m.sigma1_px[0], "seed": 0}
    pose, _ = poselib.estimate_relative_pose(m.pixels1, m.pixels2, poselib_camera(), poselib_camera(), options)
    return Rigid3(pose.R, pose.t)


def poselib_refine(m: Matches) -> tuple[int, Callable[[], object]] | None:
    poselib = optional("poselib")
    if poselib is None:
        return None
    start = poselib.CameraPose()
    start.R, start.t = POSE.rotation, unit(POSE.translation_mm)
    camera = poselib_camera()
    return 1, lambda: poselib.refine_relative_pose(m.pixels1, m.pixels2, start, camera, camera)


def poselib_camera() -> dict[str, Any]:
    return {
        "model": "PINHOLE",
        "width": CAMERA.size_px[0],
        "height": CAMERA.size_px[1],
        "params": CAMERA.parameters.tolist(),
    }


def optional(name: str) -> Any:
    """Return a module, or None where it is not installed."""
    try:
        return __import__(name)
    except ImportError:
        return None
