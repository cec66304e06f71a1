"""One fused cloud from several views of a scene with known poses, of a rig or a tracked camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.features import match_affine_features
from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainPair
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.media.images import read_image_of
from rigkit.io.ply import ply_bytes
from rigkit.reconstruction.growing.dense import DenseScene, grow_scene
from rigkit.reconstruction.growing.fuse import FusedCloud, PosedCloud, fuse_clouds
from rigkit.reconstruction.scene import reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose
from rigkit.report.pages.cloud_page import build_cloud_page
from rigkit.report.pictures.figures import as_png, cloud_figure
from rigkit.workflows.inputs.camera_files import rig_of_file, warn_if_bad, warn_if_exact, warn_of_pupils
from rigkit.workflows.options.clouds import RigSceneOptions
from rigkit.workflows.outputs.provenance import software_facts
from rigkit.workflows.outputs.results import require_folder, write_results
from rigkit.workflows.reconstruction.reconstruct_scene import CLOUD, SCENE_PAGE

PARTNERS = 3
"""Each view is paired with so many nearest ones."""
MAX_AXES_DEG = 60.0
"""Maximum angle between the axes of views to be paired; beyond it surfaces look too different to match. Views of wide
lenses are paired beyond it if there are no others."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigScene:
    """The reconstruction of a scene from a rig.

    Attributes
    ----------
    cloud : fused cloud in the frame of the first image's camera, mm.
    pairs : names of the two cameras -> number of points of the pair.
    merged : number of points that more than one pair saw.
    notes : pairs that gave no cloud, and why.
    files : relative path -> content of all results, written or not.
    """

    cloud: OrientedCloud
    pairs: Mapping[tuple[str, str], int]
    merged: int
    notes: tuple[str, ...]
    files: Mapping[str, str | bytes]

    __repr__ = brief

    def figures(self) -> dict[str, Any]:
        """Return the results of the scene as JSON values."""
        return {
            "points": len(self.cloud),
            "merged": self.merged,
            "unit": "mm",
            "pairs": [{"cameras": list(names), "points": points} for names, points in self.pairs.items()],
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False, slots=True)
class _View:
    name: str
    number: int
    """Index of the camera in the rig."""
    camera: Camera
    cam_from_world: Rigid3
    image: NDArray[np.generic]


def reconstruct_rig_views(options: RigSceneOptions, *, progress: Progress = silent) -> RigScene:
    """Reconstruct all pairs of neighbouring views, fuse their clouds, and write the results into
    `options.output`, if given.

    Raises InputError: a file cannot be read or written, a camera is missing, an image has another size than its
    camera; DegenerateError: no pair gives a cloud.
    """
    if options.output is not None:
        require_folder(options.output, force=options.force)
    rig = rig_of_file(options.rig)
    warn_if_bad(options.rig, rig.verdicts)
    warn_of_pupils(options.rig, rig)
    warn_if_exact(options.rig, rig.covariance)
    views, known = _views(options, rig.cameras), rig.quoted
    pairs = neighbouring_pairs([v.cam_from_world for v in views])
    grown: dict[tuple[str, str], PosedCloud] = {}
    notes: list[str] = []
    first: DenseScene | None = None
    for k, (i, j) in enumerate(pairs):
        progress("growing correspondences of pairs", k, len(pairs))
        one, other = views[i], views[j]
        try:
            dense = _dense(one, other, None if known is None else known.pair(one.number, other.number))
        except DegenerateError as error:
            notes.append(str(error))
            continue
        # The picture shows the pair of the first camera, whose frame is the world's.
        first = dense if first is None and i == 0 else first
        covariance = None if known is None else known.pair(one.number, views[0].number).covariance[-6:, -6:]
        grown[one.name, other.name] = PosedCloud.of(dense, one.cam_from_world.inverse(), covariance)
    progress("growing correspondences of pairs", len(pairs), len(pairs))
    if not grown:
        raise DegenerateError(
            f"'{options.rig}': none of {len(pairs)} pairs of views gives a cloud; check which camera took which image "
            f"(--names), and that the images were taken at the same time. The first: {notes[0]}"
        )
    fused = fuse_clouds(tuple(grown.values()))
    files = _files(options, fused, first)
    if options.output is not None:
        write_results(options.output, files, force=options.force, inputs=[options.rig, *options.images])
    return RigScene(
        cloud=fused.cloud,
        pairs={names: len(posed.cloud) for names, posed in grown.items()},
        merged=int((fused.pairs_of > 1).sum()),
        notes=tuple(notes),
        files=files,
    )


def neighbouring_pairs(cam_from_world: Sequence[Rigid3]) -> list[tuple[int, int]]:
    """Return pairs of views (i < j): each view with its PARTNERS nearest ones of similar axis and another centre."""
    centres = np.array([pose.inverse().translation_mm for pose in cam_from_world])
    axes = np.array([pose.rotation[2] for pose in cam_from_world])
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1)
    turned = np.degrees(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)))
    # A view with another axis comes after all others.
    far = distance + np.where(turned > MAX_AXES_DEG, 2.0 * distance.max(), 0.0)
    far[distance <= 1e-9 * max(float(distance.max()), 1.0)] = np.inf
    chosen = np.zeros(far.shape, dtype=bool)
    nearest = np.argsort(far, axis=1, kind="stable")[:, :PARTNERS]
    np.put_along_axis(chosen, nearest, np.isfinite(np.take_along_axis(far, nearest, axis=1)), axis=1)
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(chosen | chosen.T))]


def _views(options: RigSceneOptions, cameras: Mapping[str, tuple[Camera, Rigid3]]) -> list[_View]:
    """Return the views, in the frame of the first; raises InputError if the images do not fit the rig."""
    names = options.names or tuple(cameras)[: len(options.images)]
    missing = [name for name in names if name not in cameras]
    if missing or len(names) != len(options.images) or len(set(names)) < len(names):
        what = (
            f"no camera '{', '.join(missing)}'" if missing else f"{len(options.images)} images for {len(names)} names"
        )
        raise InputError(f"'{options.rig}': {what}; its cameras are {', '.join(cameras)}; one image for each (--names)")
    if len(names) < 2:
        raise InputError("a cloud needs two images or more")
    rig_from_first = cameras[names[0]][1].inverse()
    views = [
        _View(
            name,
            list(cameras).index(name),
            cameras[name][0],
            cameras[name][1] @ rig_from_first,
            read_image_of(path, cameras[name][0].size_px, options.rig),
        )
        for name, path in zip(names, options.images, strict=True)
    ]
    for k, view in enumerate(views):
        for path, other in zip(options.images[:k], views[:k], strict=True):
            if np.array_equal(view.image, other.image):
                raise InputError(
                    f"images '{path}' and '{options.images[k]}' are the same picture to the last pixel; give one of "
                    "each camera"
                )
    if not any(np.linalg.norm(v.cam_from_world.inverse().translation_mm) > 0.0 for v in views):
        raise InputError(
            f"'{options.rig}': all cameras have the same centre: without a baseline there are no distances"
        )
    return views


def _dense(one: _View, other: _View, known: UncertainPair | None) -> DenseScene:
    """Return the cloud of two views, with the rig's covariance `known` in its sigmas.

    Raises DegenerateError if they do not see the same surfaces.
    """
    moved = () if known is None else tuple(known.moved())
    pose = KnownPose(other.cam_from_world @ one.cam_from_world.inverse(), moved=moved)
    try:
        seeds = match_affine_features(one.image, other.image)
        name = f"{one.name}-{other.name}"
        sparse = reconstruct_scene(seeds, one.camera, other.camera, pair_id=name, known_pose=pose, image1=one.image)
        return grow_scene(sparse, seeds, one.image, other.image, pose_is_known=True, calibrations=known)
    except (DegenerateError, InputError) as error:
        raise DegenerateError(f"pair {one.name}, {other.name}: {error}") from error


def _files(options: RigSceneOptions, fused: FusedCloud, first: DenseScene | None) -> dict[str, str | bytes]:
    comments = [f"fused from several pairs; {int((fused.pairs_of > 1).sum())} points were seen by more than one"]
    files: dict[str, str | bytes] = {
        CLOUD: ply_bytes(
            fused.cloud, single_precision=options.single_precision, confidence=options.confidence, comments=comments
        )
    }
    if options.pictures and first is not None:
        shown = replace(first.scene.reconstruction, pair_id=options.rig.stem, cloud=fused.cloud)
        files["cloud.png"] = as_png(cloud_figure(shown))
        files[SCENE_PAGE] = build_cloud_page(f"Scene of {options.rig.stem}", fused.cloud, software_facts(), unit="mm")
    return files
