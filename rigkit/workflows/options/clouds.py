"""Options of the workflows on pairs of images, their clouds and meshes.

`rigkit.cli.console.add_options` makes arguments from them at once, so nothing heavy is imported, and annotations are
evaluated.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rigkit.core.choices import Planes, Support
from rigkit.core.errors import InputError
from rigkit.workflows.options.base import WrittenFiles


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetOptions(WrittenFiles):
    """Options of every workflow on a data set.

    Attributes
    ----------
    pairs : only the pair of this name (default: all).
    output : folder for the results; None: nothing is written.
    recalibrate : calibrate from the images again, even if there are calibration files.
    chain : work on raw pixels (default) or rectified perspective views.
    support : corners that directions are estimated from, see `direction_field`.
    det_scale : scale of DET3UDIR, see `affines_from_directions`.
    jobs : number of processes (default: one per core).
    """

    pairs: tuple[str, ...] = ()
    output: Path | None = None
    recalibrate: bool = False
    chain: Literal["raw", "rectified"] = "raw"
    support: Support = "patch"
    det_scale: str = "area"
    jobs: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidateOptions(DatasetOptions):
    """Options of a validation.

    Attributes
    ----------
    pictures : draw each pair and write the HTML report.
    pdf : also write the pictures as vector graphics.
    planes : planes used to check angles, normals and the baseline; None: as in the manifest.
    crosscheck : compare with independent methods.
    """

    pictures: bool = True
    pdf: bool = False
    planes: Planes | None = None
    crosscheck: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperOptions(DatasetOptions):
    """Options of the paper's pipeline.

    Attributes
    ----------
    pictures : write the page.
    own_solvers : with --paper: use the solvers of standard and forward motion for such pairs, not the planar one.
    """

    pictures: bool = True
    own_solvers: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructOptions(DatasetOptions):
    """Options of a reconstruction of pairs.

    Attributes
    ----------
    method : affine estimator of the normals.
    planes : each point and normal by itself ("free"), or on its board's plane, where the estimator does not matter;
        None: as in the manifest.
    pictures : draw corners, epipolar curves and the cloud.
    """

    method: str = "3SDIR"
    planes: Planes | None = None
    pictures: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportCloudOptions(WrittenFiles):
    """The cloud to export, its format, and where to write it.

    Attributes
    ----------
    output : file to write (a folder for a COLMAP model).
    kind : format: ply, npz, las or colmap.
    pair : pair of the data set whose cloud is exported (default: the only one).
    method : affine estimator of the normals.
    planes : planes that points and normals are computed on, as in `ReconstructOptions`; None: as in the manifest.
    single_precision : write a PLY in single precision (PCL reads no other).
    """

    output: Path
    kind: str
    pair: str | None = None
    method: str = "3SDIR"
    planes: Planes | None = None
    single_precision: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshOptions(WrittenFiles):
    """Parameters of the surface.

    Attributes
    ----------
    output : PLY file to write.
    depth : depth of the octree: 2^depth cells along the longest side.
    cut : part of the surface to cut off where points are sparsest.
    one_view : all points were seen from the origin: build no surface between foreground and background (default: as the
        header of the cloud says).
    """

    output: Path
    depth: int = 9
    cut: float = 0.02
    one_view: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudOptions(WrittenFiles):
    """Output of a cloud.

    Attributes
    ----------
    output : folder for the results; None: nothing is written.
    single_precision : write the cloud in single precision.
    confidence : scale normals by their confidence.
    pictures : draw the cloud and the matched features.
    """

    output: Path | None = None
    single_precision: bool = False
    confidence: bool = False
    pictures: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneOptions(CloudOptions):
    """Images or correspondences of a scene, its cameras, and options of the reconstruction.

    Attributes
    ----------
    camera : calibration of the camera (of the first image).
    camera2 : calibration of the second image's camera (default: that of the first).
    rig : the rig that took the images, instead of --camera; its extrinsics are kept fixed.
    names : cameras of the two images (default: the rig's first two).
    pose : known cam2_from_cam1, 3x4 or 4x4 numbers, mm; kept fixed.
    images : two images, whose features are matched, or which colour the cloud of `correspondences`.
    correspondences : CSV, NPZ or AffineExtractor text with affinities or directions, a matcher's NPZ or COLMAP's
        database; with --images affinities are estimated for points that have none, and the cloud is dense and coloured.
    baseline_mm : measured baseline (default: lengths are in baselines).
    pose_type : motion between the images (default: general, or that of a rectified pair).
    level_sigma_deg : standard deviation of the angles that the pose type fixes.
    grow : grow the correspondences over the surfaces of `images` into a dense cloud.
    """

    camera: Path | None = None
    camera2: Path | None = None
    rig: Path | None = None
    names: tuple[str, str] | None = None
    pose: Path | None = None
    images: tuple[Path, Path] | None = None
    correspondences: Path | None = None
    baseline_mm: float | None = None
    pose_type: str | None = None
    level_sigma_deg: float | None = None
    grow: bool = True

    @property
    def name(self) -> str:
        """Name of the scene: that of the correspondences, or of the first image, without its ending."""
        source = self.correspondences or (self.images[0] if self.images else None)
        if source is None:
            raise InputError("a scene needs two images, or a file of correspondences")
        return source.stem


@dataclass(frozen=True, slots=True, kw_only=True)
class RigSceneOptions(CloudOptions):
    """The rig and the images of a scene.

    Attributes
    ----------
    rig : rig with the cameras' poses: rigkit's file, a Kalibr camchain, or a stereo pair of OpenCV or MATLAB.
    images : one image for each camera.
    names : cameras of the images; None: the rig's first ones, in its order.
    """

    rig: Path
    images: tuple[Path, ...]
    names: tuple[str, ...] | None = None
