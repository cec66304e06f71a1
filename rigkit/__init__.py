"""rigkit: cameras, rigs and reconstructions that are right.

Layers, each importing only rows below it (tests/test_architecture.py reads the imports)::

    12  cli              one module a verb: parse, call a workflow, print
    11  workflows        what a verb does: typed options in, typed results out, no printing
    10  report           figures, pages, tables in Markdown, CSV and LaTeX
     9  io               manifests, sessions, calibration and corner files, PLY, images
     8  validation | study | benchmark    against what was measured | synthetic studies | what measures detection
     7  reconstruction | planning         from detections, or correspondences, to a cloud | which picture to take next
     6  detection | identification    from an image to grids of corners | which board is which
     5  affine | relative_pose | calibration | synthetic | interop
     4  rectification    perspective, stereo and panoramic views
     3  cameras          protocol, one file a model, registry
     2  geometry         rigid motions, rotations, planes, triangulation
     1  core | optim     errors, arrays, boards, detections, matches, clouds, truth | least squares, robust scale
     0  kernels          compiled loops

Conventions: `b_from_a` maps a to b, `x_in_a` lives in a, touching names match; camera x right, y down, z forward; pixel
(0, 0) is the centre of the top-left pixel; `x2.T @ F21 @ x1 = 0`, `d2 ~ A21 @ d1`; lengths in mm; angles in radians
inside, degrees in files and reports.

>>> import numpy as np, rigkit
>>> cam2_from_cam1 = rigkit.Rigid3(np.eye(3), [-300.0, 0.0, 0.0])
>>> float(np.linalg.norm(cam2_from_cam1.translation_mm))
300.0
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigkit.affine.affinities import EpipolarNormals
    from rigkit.affine.homography import affines_from_homography, homography_from_affines, homography_from_plane
    from rigkit.affine.mixed import affines_from_mixed_directions
    from rigkit.affine.normal import normals_from_affines
    from rigkit.affine.registry import affines_from_directions
    from rigkit.calibration.calibrate import calibrate
    from rigkit.calibration.hand_eye import HandEye, hand_eye
    from rigkit.calibration.result import Calibration
    from rigkit.calibration.rig.calibrate import calibrate_rig
    from rigkit.calibration.rig.result import RigCalibration
    from rigkit.cameras.base import Camera
    from rigkit.cameras.compare import CameraDifference, compare_cameras
    from rigkit.cameras.registry import camera_model
    from rigkit.core.boards import Board
    from rigkit.core.cloud import OrientedCloud
    from rigkit.core.detections import BoardDetection, BoardView
    from rigkit.core.errors import DegenerateError, InputError, RigkitError
    from rigkit.core.matches import DirectionPairs, Matches
    from rigkit.core.posetype import PoseType
    from rigkit.core.truth import PairTruth
    from rigkit.detection.detect import detect_boards
    from rigkit.detection.guided.guided import complete_boards
    from rigkit.geometry.rigid3 import Rigid3
    from rigkit.identification.identify import identify_pair
    from rigkit.io.calibration_file import load_calibration, load_camera, save_calibration
    from rigkit.io.images import read_image
    from rigkit.io.manifest import Dataset, load_dataset
    from rigkit.io.ply import read_ply, write_ply
    from rigkit.io.rig_file import load_rig
    from rigkit.io.rig_session import RigSession, load_rig_session
    from rigkit.io.session import Session, load_session
    from rigkit.reconstruction.pairing import MatchedPair, match_pair
    from rigkit.reconstruction.reconstruct import Reconstruction, reconstruct_pair
    from rigkit.reconstruction.scene import SceneReconstruction, reconstruct_scene
    from rigkit.rectification.rectify import rectify_map
    from rigkit.relative_pose.solvers.registry import fundamental_for
    from rigkit.report.calibration_page import CalibrationSection, build_calibration_page
    from rigkit.report.notebook import notebook_progress
    from rigkit.validation.certificate.contracts import Quantity, Task
    from rigkit.validation.checks import ValidationReport, validate
    from rigkit.validation.crosscheck import CrossCheckReport, crosscheck
    from rigkit.workflows.calibrate import CalibrateOptions, SessionCalibration, calibrate_session
    from rigkit.workflows.calibrate_any import FolderOptions, calibrate_folders, calibrate_session_file
    from rigkit.workflows.calibrate_rig import RigSessionCalibration, calibrate_rig_session
    from rigkit.workflows.camera_files import import_camera, import_rig
    from rigkit.workflows.certify import CertifiedFile, CertifyOptions, certify_file
    from rigkit.workflows.corners import Cache
    from rigkit.workflows.crosscheck import DatasetCrossCheck, crosscheck_dataset
    from rigkit.workflows.datasets import DatasetOptions
    from rigkit.workflows.demo import DemoOptions, run_demo
    from rigkit.workflows.detect import DetectionResult, DetectOptions, detect_in_images
    from rigkit.workflows.diff import CameraPair, DiffOptions, RigPair, diff
    from rigkit.workflows.export_camera import (
        ExportCameraOptions,
        ExportedCamera,
        ExportedRig,
        export_camera,
        export_rig,
    )
    from rigkit.workflows.export_cloud import ExportCloudOptions, export_cloud
    from rigkit.workflows.handeye import (
        HandEyeCalibration,
        HandEyeOptions,
        PlacedCamera,
        calibrate_hand_eye,
        camera_on_board,
    )
    from rigkit.workflows.print_board import MeasuredPrint, PrintOptions, print_board, store_measured_print
    from rigkit.workflows.reconstruct import DatasetReconstruction, ReconstructOptions, reconstruct_dataset
    from rigkit.workflows.reconstruct_scene import SceneOptions, SceneResult, reconstruct_views
    from rigkit.workflows.rectify import (
        RectificationResult,
        RectifiedImage,
        RectifyOptions,
        rectify_image,
        rectify_stereo_images,
    )
    from rigkit.workflows.study import StudyOptions, StudyResult, run_studies, run_study
    from rigkit.workflows.validate import DatasetValidation, ValidateOptions, validate_dataset

    __version__: str

__all__ = [
    "Board",
    "BoardDetection",
    "BoardView",
    "Cache",
    "CalibrateOptions",
    "Calibration",
    "CalibrationSection",
    "Camera",
    "CameraDifference",
    "CameraPair",
    "CertifiedFile",
    "CertifyOptions",
    "CrossCheckReport",
    "Dataset",
    "DatasetCrossCheck",
    "DatasetOptions",
    "DatasetReconstruction",
    "DatasetValidation",
    "DegenerateError",
    "DemoOptions",
    "DetectOptions",
    "DetectionResult",
    "DiffOptions",
    "DirectionPairs",
    "EpipolarNormals",
    "ExportCameraOptions",
    "ExportCloudOptions",
    "ExportedCamera",
    "ExportedRig",
    "FolderOptions",
    "HandEye",
    "HandEyeCalibration",
    "HandEyeOptions",
    "InputError",
    "MatchedPair",
    "Matches",
    "MeasuredPrint",
    "OrientedCloud",
    "PairTruth",
    "PlacedCamera",
    "PoseType",
    "PrintOptions",
    "Quantity",
    "ReconstructOptions",
    "Reconstruction",
    "RectificationResult",
    "RectifiedImage",
    "RectifyOptions",
    "RigCalibration",
    "RigPair",
    "RigSession",
    "RigSessionCalibration",
    "Rigid3",
    "RigkitError",
    "SceneOptions",
    "SceneReconstruction",
    "SceneResult",
    "Session",
    "SessionCalibration",
    "StudyOptions",
    "StudyResult",
    "Task",
    "ValidateOptions",
    "ValidationReport",
    "affines_from_directions",
    "affines_from_homography",
    "affines_from_mixed_directions",
    "build_calibration_page",
    "calibrate",
    "calibrate_folders",
    "calibrate_hand_eye",
    "calibrate_rig",
    "calibrate_rig_session",
    "calibrate_session",
    "calibrate_session_file",
    "camera_model",
    "camera_on_board",
    "certify_file",
    "compare_cameras",
    "complete_boards",
    "crosscheck",
    "crosscheck_dataset",
    "detect_boards",
    "detect_in_images",
    "diff",
    "export_camera",
    "export_cloud",
    "export_rig",
    "fundamental_for",
    "hand_eye",
    "homography_from_affines",
    "homography_from_plane",
    "identify_pair",
    "import_camera",
    "import_rig",
    "load_calibration",
    "load_camera",
    "load_dataset",
    "load_rig",
    "load_rig_session",
    "load_session",
    "match_pair",
    "normals_from_affines",
    "notebook_progress",
    "print_board",
    "read_image",
    "read_ply",
    "reconstruct_dataset",
    "reconstruct_pair",
    "reconstruct_scene",
    "reconstruct_views",
    "rectify_image",
    "rectify_map",
    "rectify_stereo_images",
    "run_demo",
    "run_studies",
    "run_study",
    "save_calibration",
    "store_measured_print",
    "validate",
    "validate_dataset",
    "write_ply",
]

_NAMES_OF = {
    "rigkit.affine.affinities": ("EpipolarNormals",),
    "rigkit.affine.homography": ("affines_from_homography", "homography_from_affines", "homography_from_plane"),
    "rigkit.affine.mixed": ("affines_from_mixed_directions",),
    "rigkit.affine.normal": ("normals_from_affines",),
    "rigkit.affine.registry": ("affines_from_directions",),
    "rigkit.calibration.calibrate": ("calibrate",),
    "rigkit.calibration.result": ("Calibration",),
    "rigkit.calibration.rig.calibrate": ("calibrate_rig",),
    "rigkit.calibration.rig.result": ("RigCalibration",),
    "rigkit.cameras.base": ("Camera",),
    "rigkit.cameras.compare": ("CameraDifference", "compare_cameras"),
    "rigkit.cameras.registry": ("camera_model",),
    "rigkit.core.boards": ("Board",),
    "rigkit.core.cloud": ("OrientedCloud",),
    "rigkit.core.detections": ("BoardDetection", "BoardView"),
    "rigkit.core.errors": ("DegenerateError", "InputError", "RigkitError"),
    "rigkit.core.matches": ("DirectionPairs", "Matches"),
    "rigkit.core.posetype": ("PoseType",),
    "rigkit.core.truth": ("PairTruth",),
    "rigkit.detection.detect": ("detect_boards",),
    "rigkit.detection.guided.guided": ("complete_boards",),
    "rigkit.geometry.rigid3": ("Rigid3",),
    "rigkit.identification.identify": ("identify_pair",),
    "rigkit.io.calibration_file": ("load_calibration", "load_camera", "save_calibration"),
    "rigkit.io.images": ("read_image",),
    "rigkit.io.manifest": ("Dataset", "load_dataset"),
    "rigkit.io.ply": ("read_ply", "write_ply"),
    "rigkit.io.rig_file": ("load_rig",),
    "rigkit.io.rig_session": ("RigSession", "load_rig_session"),
    "rigkit.io.session": ("Session", "load_session"),
    "rigkit.reconstruction.pairing": ("MatchedPair", "match_pair"),
    "rigkit.reconstruction.reconstruct": ("Reconstruction", "reconstruct_pair"),
    "rigkit.reconstruction.scene": ("SceneReconstruction", "reconstruct_scene"),
    "rigkit.rectification.rectify": ("rectify_map",),
    "rigkit.relative_pose.solvers.registry": ("fundamental_for",),
    "rigkit.report.calibration_page": ("CalibrationSection", "build_calibration_page"),
    "rigkit.report.notebook": ("notebook_progress",),
    "rigkit.validation.certificate.contracts": ("Quantity", "Task"),
    "rigkit.validation.checks": ("ValidationReport", "validate"),
    "rigkit.validation.crosscheck": ("CrossCheckReport", "crosscheck"),
    "rigkit.workflows.calibrate": ("CalibrateOptions", "SessionCalibration", "calibrate_session"),
    "rigkit.workflows.calibrate_any": ("FolderOptions", "calibrate_folders", "calibrate_session_file"),
    "rigkit.workflows.calibrate_rig": ("RigSessionCalibration", "calibrate_rig_session"),
    "rigkit.workflows.certify": ("CertifiedFile", "CertifyOptions", "certify_file"),
    "rigkit.workflows.corners": ("Cache",),
    "rigkit.workflows.crosscheck": ("DatasetCrossCheck", "crosscheck_dataset"),
    "rigkit.workflows.camera_files": ("import_camera", "import_rig"),
    "rigkit.workflows.datasets": ("DatasetOptions",),
    "rigkit.workflows.demo": ("DemoOptions", "run_demo"),
    "rigkit.workflows.detect": ("DetectOptions", "DetectionResult", "detect_in_images"),
    "rigkit.workflows.diff": ("CameraPair", "DiffOptions", "RigPair", "diff"),
    "rigkit.workflows.export_camera": (
        "ExportCameraOptions",
        "ExportedCamera",
        "ExportedRig",
        "export_camera",
        "export_rig",
    ),
    "rigkit.workflows.export_cloud": ("ExportCloudOptions", "export_cloud"),
    "rigkit.workflows.handeye": (
        "HandEyeCalibration",
        "HandEyeOptions",
        "PlacedCamera",
        "calibrate_hand_eye",
        "camera_on_board",
    ),
    "rigkit.calibration.hand_eye": ("HandEye", "hand_eye"),
    "rigkit.workflows.print_board": ("MeasuredPrint", "PrintOptions", "print_board", "store_measured_print"),
    "rigkit.workflows.reconstruct": ("DatasetReconstruction", "ReconstructOptions", "reconstruct_dataset"),
    "rigkit.workflows.reconstruct_scene": ("SceneOptions", "SceneResult", "reconstruct_views"),
    "rigkit.workflows.rectify": (
        "RectificationResult",
        "RectifiedImage",
        "RectifyOptions",
        "rectify_image",
        "rectify_stereo_images",
    ),
    "rigkit.workflows.study": ("StudyOptions", "StudyResult", "run_studies", "run_study"),
    "rigkit.workflows.validate": ("DatasetValidation", "ValidateOptions", "validate_dataset"),
}
"""Module -> the public names in it, as imported above for type checkers."""

logging.getLogger(__name__).addHandler(logging.NullHandler())

_HOMES = {name: module for module, names in _NAMES_OF.items() for name in names}


if not TYPE_CHECKING:
    # Hidden from type checkers, which would take every misspelt name for one that it finds.
    def __getattr__(name: str) -> object:
        """Import public names on first use, so that `import rigkit` and `rigkit --help` stay quick."""
        if name in _HOMES:
            found = getattr(importlib.import_module(_HOMES[name]), name)
        elif name == "__version__":
            from importlib.metadata import version

            found = version("rigkit")
        else:
            raise AttributeError(f"module 'rigkit' has no attribute '{name}'")
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
