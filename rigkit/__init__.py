"""rigkit: cameras, rigs and reconstructions that are right.

Layers, each importing only rows below it (tests/test_architecture.py reads the imports)::

    12  cli              one module a verb: parse, call a workflow, print
    11  workflows        what a verb does: typed options in, typed results out, no printing
    10  report           figures, pages, tables in Markdown, CSV and LaTeX
     9  io               manifests, sessions, calibration and corner files, PLY, images
     8  validation | study | benchmark    against what was measured | synthetic studies | what measures detection
     7  reconstruction   from detections, or correspondences, to an oriented cloud
     6  detection | identification    from an image to grids of corners | which board is which
     5  affine | relative_pose | calibration | synthetic | interop
     4  rectification    perspective, stereo and panoramic views
     3  cameras          protocol, one file a model, registry
     2  geometry | optim
     1  core             errors, arrays, boards, detections, matches, clouds, measured truth
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
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Board": "rigkit.core.boards",
    "BoardDetection": "rigkit.core.detections",
    "BoardView": "rigkit.core.detections",
    "Calibration": "rigkit.calibration.result",
    "Camera": "rigkit.cameras.base",
    "DegenerateError": "rigkit.core.errors",
    "DirectionPairs": "rigkit.core.matches",
    "InputError": "rigkit.core.errors",
    "MatchedPair": "rigkit.reconstruction.pairing",
    "Matches": "rigkit.core.matches",
    "OrientedCloud": "rigkit.core.cloud",
    "PairTruth": "rigkit.core.truth",
    "PoseType": "rigkit.core.posetype",
    "Reconstruction": "rigkit.reconstruction.reconstruct",
    "Rigid3": "rigkit.geometry.rigid3",
    "RigkitError": "rigkit.core.errors",
    "affines_from_directions": "rigkit.affine.registry",
    "calibrate": "rigkit.calibration.calibrate",
    "camera_model": "rigkit.cameras.registry",
    "compare_cameras": "rigkit.cameras.compare",
    "complete_boards": "rigkit.detection.guided.guided",
    "crosscheck": "rigkit.validation.crosscheck",
    "detect_boards": "rigkit.detection.detect",
    "fundamental_for": "rigkit.relative_pose.solvers.registry",
    "identify_pair": "rigkit.identification.identify",
    "load_calibration": "rigkit.io.calibration_file",
    "load_camera": "rigkit.io.calibration_file",
    "load_dataset": "rigkit.io.manifest",
    "match_pair": "rigkit.reconstruction.pairing",
    "normals_from_affines": "rigkit.affine.normal",
    "read_image": "rigkit.io.images",
    "read_ply": "rigkit.io.ply",
    "reconstruct_pair": "rigkit.reconstruction.reconstruct",
    "reconstruct_scene": "rigkit.reconstruction.scene",
    "rectify_map": "rigkit.rectification.rectify",
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
