"""Two views of any scene without boards, by matched features or from a file of correspondences."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import TILTS, match_affine_features, need_alignment, with_affinities
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera, far_camera
from rigkit.cameras.uncertain import PosedPair, UncertainCamera, UncertainPair
from rigkit.core.arrays import without_nan
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.corners.correspondences import correspondences_text, read_correspondences
from rigkit.io.disk.reading import about, read_text
from rigkit.io.disk.writing import npz_bytes
from rigkit.io.media.images import read_image_of
from rigkit.io.ply import ply_bytes
from rigkit.reconstruction.calibration_shifts import calibration_shifts, with_calibrations
from rigkit.reconstruction.growing.dense import grow_scene
from rigkit.reconstruction.moved_cameras import Calibrations, moved_pairs
from rigkit.reconstruction.scene import SceneReconstruction, correct_moving_pupils, reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose
from rigkit.report.pages.cloud_page import build_cloud_page
from rigkit.report.pictures.figures import as_png, cloud_figure, epipolar_figure
from rigkit.report.pictures.scene_figure import normals_png
from rigkit.workflows.inputs.camera_files import (
    calibration_of_file,
    import_camera,
    import_near_camera,
    import_pair,
    rig_of_file,
    warn_if_exact,
)
from rigkit.workflows.options.clouds import SceneOptions
from rigkit.workflows.outputs.provenance import software_facts
from rigkit.workflows.outputs.results import require_folder, write_results

CLOUD = "scene.ply"
SCENE_PAGE = "scene.html"
"""Page with an interactive view of the cloud."""
MAPS = "maps.npz"
"""Depth, range and normal maps of the first image."""

Images: TypeAlias = tuple[NDArray[Any], NDArray[Any]]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class SceneResult:
    """The reconstruction of a scene.

    Attributes
    ----------
    name : name of the scene.
    scene : the reconstruction, with the inliers.
    correspondences : all correspondences.
    files : relative path -> content of all results, written or not.
    """

    name: str
    scene: SceneReconstruction
    correspondences: Correspondences
    files: Mapping[str, str | bytes]

    __repr__ = brief

    def _repr_html_(self) -> str:
        return self.scene._repr_html_()

    def figures(self) -> dict[str, Any]:
        """Return the results of the scene as JSON values."""
        r = self.scene.reconstruction
        return {
            "pose_type": str(r.pose_type),
            "correspondences": len(self.correspondences),
            "inliers": int(self.scene.inliers.sum()),
            "points": len(r.cloud),
            "unit": self.scene.unit,
            "cam2_from_cam1": r.cam2_from_cam1.matrix().tolist(),
            "pose_covariance": None if r.pose_covariance is None else r.pose_covariance.tolist(),
            "sigma_px": self.scene.sigma_px,
            "sigma_A": without_nan(self.scene.sigma_A),
            "sampson_rms_px": r.sampson_rms_px,
            "notes": list(r.notes),
        }


def reconstruct_views(options: SceneOptions, *, progress: Progress = silent) -> SceneResult:
    """Reconstruct two views of a scene and write the results if `options.output` is given.

    Raises InputError: a file cannot be read or written, an image has another size than its camera, both images are the
    same; DegenerateError: the correspondences do not determine the pose.
    """
    name = options.name
    for what, value in (("baseline", options.baseline_mm), ("sigma of a level", options.level_sigma_deg)):
        if value is not None and not 0.0 < value < np.inf:
            raise InputError(f"'{name}': the {what} must be positive, got {value}")
    if options.output is not None:
        require_folder(options.output, force=options.force)
    near, known_pose, notes = _cameras(options)
    camera1, camera2 = far_camera(near[0]), far_camera(near[1])
    of = _calibrations(options, near)
    if known_pose is not None and of is not None:
        moved = moved_pairs(PosedPair(camera1, camera2, known_pose.cam2_from_cam1), of)
        known_pose = replace(known_pose, moved=tuple(moved))
    images = None
    if options.images:
        a, b = options.images
        of1, of2 = options.rig or options.camera, options.rig or options.camera2 or options.camera
        images = (read_image_of(a, camera1.size_px, str(of1)), read_image_of(b, camera2.size_px, str(of2)))
        if np.array_equal(*images):
            raise InputError(
                f"images A '{a}' and B '{b}' are the same picture to the last pixel: no baseline; give two images "
                "taken from different places"
            )
    given = (options.correspondences, options.rig, options.camera, options.camera2, options.pose)
    with about(*(path for path in given if path is not None)):
        scene, found = _sparse(options, near, known_pose, images, progress)
    maps: Mapping[str, NDArray[Any]] = {}
    known = known_pose is not None
    if images and options.grow:
        scene, found, maps = _grown(scene, found, images, progress, pose_is_known=known, of=of)
    if of is not None and not maps:
        both = (of,) if isinstance(of, UncertainPair) else of
        shifts = calibration_shifts(scene.reconstruction, *both, pose_is_known=known)
        scene = replace(scene, reconstruction=with_calibrations(scene.reconstruction, shifts))
    r = scene.reconstruction
    if isinstance(of, tuple) and not all(known is None or known.covariance.any() for known in of):
        r = replace(r, cloud=replace(r.cloud, calibration_in_sigmas=False))  # One file of two states no uncertainty.
    scene = replace(scene, reconstruction=replace(r, notes=(*notes, *r.notes)))
    files = _files(options, scene, found, images)
    if maps:
        files[MAPS] = npz_bytes(maps)
    if options.output is not None:
        cameras = (options.camera, options.camera2, options.rig, options.pose)
        read = (*(options.images or ()), options.correspondences, *cameras)
        write_results(options.output, files, force=options.force, inputs=[path for path in read if path])
    return SceneResult(name=name, scene=scene, correspondences=found, files=files)


def _cameras(options: SceneOptions) -> tuple[tuple[Camera, Camera], KnownPose | None, list[str]]:
    """Return the cameras of both images, their relative pose if known, and notes.

    For a reconstruction in mm without growing, they are the cameras for points in mm (`NearCamera`); growing needs
    central cameras.
    """
    metric = options.rig is not None or options.pose is not None or options.baseline_mm is not None
    near = metric and not (options.images and options.grow)
    if options.rig is not None:
        if options.camera or options.camera2 or options.pose:
            raise InputError("a scene of a rig: the rig's file has the cameras and their pose; leave the others out")
        _, cameras, cam2_from_cam1 = import_pair(options.rig, options.names, near=near)
        return cameras, KnownPose(cam2_from_cam1), []
    if options.camera is None:
        raise InputError("a scene needs a calibration: of its camera, or of the rig that took both images")
    read = import_near_camera if near else import_camera
    camera1 = read(options.camera)
    camera2 = read(options.camera2) if options.camera2 else camera1
    known = None if options.pose is None else KnownPose(_read_pose(options.pose))
    notes = []
    if options.camera2 is None:
        notes.append("one calibration is used for both images (one moved camera); of two cameras give --camera2")
    return (camera1, camera2), known, notes


def _calibrations(options: SceneOptions, cameras: tuple[Camera, Camera]) -> Calibrations | None:
    """Return the cameras with their covariances (zero if a file has none); None if no file has one."""
    if options.rig is not None:
        rig = rig_of_file(options.rig)
        names = list(rig.cameras)
        chosen = options.names or names[:2]
        warn_if_exact(options.rig, known_rig := rig.quoted)
        return None if known_rig is None else known_rig.pair(*(names.index(name) for name in chosen))
    found = [
        None
        if path is None or (known := calibration_of_file(path)) is None
        else uncertain_camera(known, near=isinstance(camera, NearCamera))
        for path, camera in zip((options.camera, options.camera2), cameras, strict=True)
    ]
    for path, of_file in zip((options.camera, options.camera2), found, strict=True):
        if path is not None:
            warn_if_exact(path, of_file)
    if all(known is None for known in found):
        return None
    first, second = (
        known or UncertainCamera(camera, np.zeros((camera.parameters.size,) * 2))
        for camera, known in zip(cameras, found, strict=True)
    )
    return first, None if options.camera2 is None else second


def _read_pose(path: Path) -> Rigid3:
    """Return cam2_from_cam1 of a text or JSON file of 3 x 4 or 4 x 4 numbers; raises InputError for anything else."""
    words = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.sub(r'"[^"]*"', "", read_text(path, "pose")))
    if len(words) not in (12, 16):
        raise InputError(
            f"pose '{path}': {len(words)} numbers; expected the rows of [R t], 3 x 4, or of a 4 x 4 matrix"
        )
    matrix = np.vstack([np.array(words[:12], dtype=np.float64).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    if len(words) == 16 and not np.allclose(np.array(words[12:], dtype=np.float64), matrix[3]):
        raise InputError(f"pose '{path}': the last row of a pose must be 0 0 0 1")
    try:
        pose = Rigid3.from_matrix(matrix)
    except InputError as error:
        raise InputError(f"pose '{path}': {error}; correct the numbers") from error
    if not np.linalg.norm(pose.translation_mm) > 0.0:
        raise InputError(f"pose '{path}': no translation, so no distances; give cam2_from_cam1 in mm")
    return pose


def _sparse(
    options: SceneOptions,
    cameras: tuple[Camera, Camera],
    known_pose: KnownPose | None,
    images: Images | None,
    progress: Progress,
) -> tuple[SceneReconstruction, Correspondences]:
    """Return the scene reconstructed from the given or matched correspondences, and these.

    If plain features do not determine the pose, features of tilted views are matched.
    """
    lenses = far_camera(cameras[0]), far_camera(cameras[1])

    def scene_of(found: Correspondences) -> SceneReconstruction:
        return reconstruct_scene(
            found,
            *lenses,
            pair_id=options.name,
            pose_type=options.pose_type,
            level_sigma_rad=None if options.level_sigma_deg is None else float(np.deg2rad(options.level_sigma_deg)),
            baseline_mm=options.baseline_mm,
            known_pose=known_pose,
            image1=images[0] if images else None,
        )

    if options.correspondences:
        found = read_correspondences(options.correspondences, [path.name for path in options.images or ()])
        if images and need_alignment(found):
            found = with_affinities(found, *images)
        return correct_moving_pupils(scene_of, found, cameras), found
    assert images is not None
    for k, tilts in enumerate((None, TILTS)):
        progress("matching affine features", 0, 1)
        found = match_affine_features(*images, tilts=tilts)
        progress("matching affine features", 1, 1)
        try:
            return correct_moving_pupils(scene_of, found, cameras), found
        except DegenerateError as error:
            if not k:
                continue
            if options.rig is not None and _fits(scene_of, found.exchanged()):
                one, other = options.images or ("", "")
                raise DegenerateError(
                    f"'{options.name}': images '{one}' and '{other}' are exchanged: in the opposite order they fit "
                    "the rig; give them in the order of its cameras, or name these with --names"
                ) from error
            raise
    raise AssertionError("one of two attempts returns or raises")


def _grown(
    scene: SceneReconstruction,
    seeds: Correspondences,
    images: Images,
    progress: Progress,
    *,
    pose_is_known: bool,
    of: Calibrations | None,
) -> tuple[SceneReconstruction, Correspondences, Mapping[str, NDArray[Any]]]:
    """Return the dense scene, its correspondences and maps; if growing fails, the sparse scene with a note."""
    progress("growing correspondences", 0, 1)
    try:
        dense = grow_scene(scene, seeds, *images, pose_is_known=pose_is_known, calibrations=of)
    except DegenerateError as error:
        notes = (*scene.reconstruction.notes, f"no dense cloud: {error}")
        return replace(scene, reconstruction=replace(scene.reconstruction, notes=notes)), seeds, {}
    finally:
        progress("growing correspondences", 1, 1)
    return dense.scene, dense.correspondences, dense.maps()


def _files(
    options: SceneOptions, scene: SceneReconstruction, found: Correspondences, images: Images | None
) -> dict[str, str | bytes]:
    r, unit = scene.reconstruction, scene.unit
    files: dict[str, str | bytes] = {
        CLOUD: ply_bytes(r.cloud, unit=unit, single_precision=options.single_precision, confidence=options.confidence)
    }
    if not options.correspondences:
        files["correspondences.csv"] = correspondences_text(found)
    if not options.pictures:
        return files
    files["cloud.png"] = as_png(cloud_figure(r, unit=unit))
    files[SCENE_PAGE] = build_cloud_page(f"Scene {r.pair_id}", r.cloud, software_facts(), unit=unit)
    if images:
        files["epipolar.png"] = as_png(epipolar_figure(r, *images, every=max(1, len(r.cloud) // 40)))
        files["normals.png"] = normals_png(scene, found, *images)
    return files


def _fits(scene_of: Callable[[Correspondences], SceneReconstruction], found: Correspondences) -> bool:
    try:
        scene_of(found)
    except DegenerateError:
        return False
    return True
