"""rigkit: cameras, rigs and reconstructions that are right.

Layers, each importing only rows below it (tests/test_architecture.py reads the imports)::

    8  cli           one module a verb
    7  report        figures, HTML report, tables in Markdown, CSV and LaTeX
    6  io            manifests, calibration files, corner files, PLY, images
    5  validation    planes, angles, baseline, cross-check, tables as data
    4  pairing | reconstruct | scene   the pipeline from detections, or correspondences, to a Reconstruction
    3  corners | affine | fundamental | calibration | synthetic | interop
    2  cameras       protocol, models, rectification, registry
    1  geometry | boards | detections | matches | cloud | posetype | processes | progress
    0  errors | arrays | native (compiled kernels, optional)

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
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Board": "rigkit.boards",
    "BoardDetection": "rigkit.detections",
    "BoardView": "rigkit.detections",
    "Calibration": "rigkit.calibration.result",
    "Camera": "rigkit.cameras.base",
    "DegenerateError": "rigkit.errors",
    "DirectionPairs": "rigkit.matches",
    "InputError": "rigkit.errors",
    "MatchedPair": "rigkit.pairing",
    "Matches": "rigkit.matches",
    "OrientedCloud": "rigkit.cloud",
    "PairTruth": "rigkit.truth",
    "PoseType": "rigkit.posetype",
    "Reconstruction": "rigkit.reconstruct",
    "Rigid3": "rigkit.geometry.rigid3",
    "RigkitError": "rigkit.errors",
    "affines_from_directions": "rigkit.affine.registry",
    "calibrate": "rigkit.calibration.calibrate",
    "camera_model": "rigkit.cameras.registry",
    "compare_cameras": "rigkit.cameras.compare",
    "complete_boards": "rigkit.corners.guided",
    "crosscheck": "rigkit.validation.crosscheck",
    "detect_boards": "rigkit.corners.detect",
    "fundamental_for": "rigkit.fundamental.registry",
    "identify_pair": "rigkit.corners.identify",
    "load_calibration": "rigkit.io.calibration_file",
    "load_camera": "rigkit.io.calibration_file",
    "load_dataset": "rigkit.io.manifest",
    "match_pair": "rigkit.pairing",
    "normals_from_affines": "rigkit.affine.normal",
    "read_image": "rigkit.io.images",
    "read_ply": "rigkit.io.ply",
    "reconstruct_pair": "rigkit.reconstruct",
    "reconstruct_scene": "rigkit.scene",
    "rectify_map": "rigkit.cameras.rectify",
    "save_calibration": "rigkit.io.calibration_file",
    "validate": "rigkit.validation.checks",
    "write_ply": "rigkit.io.ply",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    """Import public names on first use, so that `import rigkit` and `rigkit --help` stay quick."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'rigkit' has no attribute '{name}'")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
