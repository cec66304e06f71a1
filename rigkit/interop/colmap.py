"""COLMAP through pycolmap, which only this module imports, inside its functions.

COLMAP's pixel origin is the corner of the top-left pixel, so that (0.5, 0.5) is its centre. COLMAP cannot represent
rays at 90 degrees and beyond: they are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels, Points, Rays
from rigkit.core.errors import DegenerateError
from rigkit.geometry.relative_pose import relative_pose, relative_pose_covariance
from rigkit.geometry.rigid3 import Rigid3

HALF_PIXEL = 0.5
NATIVE = {"pinhole": "PINHOLE", "brown": "FULL_OPENCV", "kannala_brandt": "OPENCV_FISHEYE"}
"""rigkit's model -> COLMAP's with the same equations and order of parameters."""
NATIVE_LENGTH = {"PINHOLE": 4, "FULL_OPENCV": 12, "OPENCV_FISHEYE": 8}
STAND_IN = "SIMPLE_FISHEYE"
"""For models that COLMAP lacks: rays are projected by an equidistant lens of the same focal length."""
MAX_ANGLE_RAD = np.deg2rad(88.0)
"""COLMAP divides by z: rays at larger angles from the axis are left out."""
MAX_ERROR_PX = 4.0
"""COLMAP's default threshold for inliers: distance from the epipolar line."""
GRADIENT_TOLERANCE = 1e-10
"""COLMAP's default of 1e-4 stops 1e-5 rad before the optimum."""


@dataclass(frozen=True, eq=False, slots=True)
class ColmapPair:
    """A pair in COLMAP's conventions.

    Attributes
    ----------
    cameras : two `pycolmap.Camera`.
    pixels1, pixels2 : (N, 2) pixels of the matches that COLMAP can represent.
    used : (M,) mask of these matches.
    """

    cameras: tuple[Any, Any]
    pixels1: Pixels
    pixels2: Pixels
    used: BoolArray


@dataclass(frozen=True, eq=False, slots=True)
class ColmapResult:
    """COLMAP's solution of a pair; translations have unit length.

    Attributes
    ----------
    two_view : relative pose of `estimate_calibrated_two_view_geometry`.
    adjusted : relative pose after two-view bundle adjustment with fixed intrinsics.
    adjusted_covariance : (6, 6) of (left rotation perturbation rad, translation in baselines) for corners of 1 px
        standard deviation per axis; zero along the translation, whose length is fixed. NaN if COLMAP has none.
    points : (N, 3) adjusted points in the frame of camera 1, in baselines; NaN for dropped matches.
    rms_px : root mean square reprojection error, 2-D per observation, px.
    inliers : number of inliers.
    """

    two_view: Rigid3
    adjusted: Rigid3
    adjusted_covariance: FloatArray
    points: Points
    rms_px: float
    inliers: int


def colmap_pair(camera1: Camera, camera2: Camera, pixels1: Pixels, pixels2: Pixels) -> ColmapPair:
    """Return cameras and corners in COLMAP's conventions, without matches beyond MAX_ANGLE_RAD."""
    rays1, valid1 = camera1.unproject(pixels1)
    rays2, valid2 = camera2.unproject(pixels2)
    limit = np.cos(MAX_ANGLE_RAD)
    used = valid1 & valid2 & (rays1[:, 2] > limit) & (rays2[:, 2] > limit)
    one, first = _as_colmap(camera1, pixels1[used], rays1[used], 1)
    two, second = _as_colmap(camera2, pixels2[used], rays2[used], 2)
    return ColmapPair((one, two), first, second, used)


def solve_pair(pair: ColmapPair, *, seed: int = 0) -> ColmapResult:
    """Return COLMAP's two-view geometry, triangulation and bundle adjustment of the pair; reproducible for a `seed`.

    Raises DegenerateError if COLMAP finds no relative pose.
    """
    import pycolmap

    pycolmap.set_random_seed(seed)
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = seed
    options.ransac.max_error = MAX_ERROR_PX
    count = len(pair.pixels1)
    matches = np.repeat(np.arange(count, dtype=np.uint32)[:, None], 2, axis=1)
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        pair.cameras[0], pair.pixels1, pair.cameras[1], pair.pixels2, matches, options
    )
    if geometry is None or geometry.cam2_from_cam1 is None or len(geometry.inlier_matches) < 8:
        raise DegenerateError(f"pycolmap finds no relative pose in {count} matches; see the corners and calibrations")
    two_view = _unit_baseline(geometry.cam2_from_cam1)
    kept = np.unique(np.asarray(geometry.inlier_matches)[:, 0].astype(np.int64))
    model, point_ids, triangulated = _reconstruction(pair, two_view, kept)
    covariance = _adjust(model)
    found = relative_pose(_pose(model, 1), _pose(model, 2))
    length = float(np.linalg.norm(found.translation_mm))
    points = np.full((count, 3), np.nan)
    in_world = np.array([model.point3D(i).xyz for i in point_ids])
    points[kept[triangulated]] = _pose(model, 1).apply(in_world) / length
    # The length of the translation is fixed: no uncertainty along it.
    across = np.eye(3) - np.outer(found.translation_mm, found.translation_mm) / length**2
    scale = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), across / length]])
    return ColmapResult(
        two_view,
        Rigid3(found.rotation, found.translation_mm / length),
        scale @ covariance @ scale.T,
        points,
        _rms_px(model),
        len(kept),
    )


def _as_colmap(camera: Camera, pixels: Pixels, rays: Rays, camera_id: int) -> tuple[Any, Pixels]:
    """Return the camera for COLMAP and the corners in its pixels."""
    import pycolmap

    name = NATIVE.get(camera.model, STAND_IN)
    if name == STAND_IN:
        parameters = np.array([camera.focal_px, camera.size_px[0] / 2.0, camera.size_px[1] / 2.0])
        flat = np.linalg.norm(rays[:, :2], axis=1)
        angle = np.arctan2(flat, rays[:, 2])
        # angle / sin(angle) is 1 on the axis.
        scale = np.divide(angle, flat, out=np.ones_like(angle), where=flat > 0.0)
        shifted = parameters[0] * scale[:, None] * rays[:, :2] + parameters[1:]
    else:
        parameters = np.zeros(NATIVE_LENGTH[name])
        parameters[: len(camera.parameters)] = camera.parameters
        parameters[2:4] += HALF_PIXEL
        shifted = pixels + HALF_PIXEL
    width, height = camera.size_px
    out = pycolmap.Camera(camera_id=camera_id, model=name, width=width, height=height, params=parameters.tolist())
    return out, np.ascontiguousarray(shifted)


def _reconstruction(pair: ColmapPair, cam2_from_cam1: Rigid3, kept: IntArray) -> tuple[Any, list[int], BoolArray]:
    """Return a pycolmap reconstruction of the two views, its point ids, and which of `kept` were triangulated."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for camera in pair.cameras:
        model.add_camera_with_trivial_rig(camera)
    poses = (Rigid3.identity(), cam2_from_cam1)
    for image_id, (pixels, pose) in enumerate(zip((pair.pixels1, pair.pixels2), poses, strict=True), start=1):
        image = pycolmap.Image(name=f"view{image_id}", keypoints=pixels[kept], camera_id=image_id, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose.matrix()[:3]))
    rays = [_rays(pair.cameras[i], pixels[kept]) for i, pixels in enumerate((pair.pixels1, pair.pixels2))]
    point_ids: list[int] = []
    triangulated = np.zeros(len(kept), dtype=bool)
    both = [pycolmap.Rigid3d(pose.matrix()[:3]) for pose in poses]
    for k in range(len(kept)):
        xyz = pycolmap.triangulate_mid_point(both[1], rays[0][k], rays[1][k])
        if xyz is None:
            continue
        track = pycolmap.Track()
        track.add_element(1, k)
        track.add_element(2, k)
        point_ids.append(model.add_point3D(np.asarray(xyz), track))
        triangulated[k] = True
    return model, point_ids, triangulated


def _rays(camera: Any, pixels: Pixels) -> Rays:
    xy = np.asarray(camera.cam_from_img(pixels))
    out = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def _adjust(model: Any) -> FloatArray:
    """Adjust poses and points of the model in place, intrinsics fixed; return the covariance of cam2_from_cam1."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.gradient_tolerance = GRADIENT_TOLERANCE
    solver.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in (1, 2):
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.THREE_POINTS)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    found = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    parts = [] if found is None else [found.get_cam_cov_from_world(1), found.get_cam_cov_from_world(2)]
    cross = None if found is None else found.get_cam_cross_cov_from_world(1, 2)
    if cross is None or any(part is None for part in parts):
        return np.full((6, 6), np.nan)
    joint = np.block([[parts[0], cross], [np.asarray(cross).T, parts[1]]])
    # Ceres' quaternion tangent is half the rotation vector. COLMAP's relative covariance does not correct for that.
    unhalved = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0] * 2)
    return relative_pose_covariance(_pose(model, 1), _pose(model, 2), unhalved @ joint @ unhalved)


def _pose(model: Any, image_id: int) -> Rigid3:
    return Rigid3.from_matrix(model.image(image_id).cam_from_world().matrix())


def _rms_px(model: Any) -> float:
    squares: list[float] = []
    for image in model.images.values():
        for point in image.points2D:
            if point.has_point3D():
                seen = image.project_point(model.point3D(point.point3D_id).xyz)
                squares.append(np.nan if seen is None else float(np.sum((np.asarray(seen) - point.xy) ** 2)))
    return float(np.sqrt(np.mean(squares)))


def _unit_baseline(cam2_from_cam1: Any) -> Rigid3:
    pose = Rigid3.from_matrix(cam2_from_cam1.matrix())
    length = float(np.linalg.norm(pose.translation_mm))
    if not length > 0.0:
        raise DegenerateError(
            "pycolmap finds a relative pose without baseline; the two images show the same view; "
            "take them from different places"
        )
    return Rigid3(pose.rotation, pose.translation_mm / length)
