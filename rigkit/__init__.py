"""rigkit: calibrate cameras and rigs, reconstruct oriented point clouds, and validate both.

Layers, each of which imports only lower rows (tests/architecture/test_architecture.py checks this)::

    12  cli              one module for each verb: parse, call a workflow, print
    11  workflows        one function for each verb: typed options and results, no printing
    10  report | coach   figures, pages, tables in Markdown, CSV and LaTeX | a guided capture on a local page
     9  io               manifests, sessions, calibration and corner files, PLY, images
     8  validation | study   comparison with measurements | synthetic studies
     7  reconstruction | planning        clouds from detections or correspondences | next best pictures
     6  detection | identification   grids of corners in images | identities of boards
     5  affine | relative_pose | calibration | synthetic | interop     estimators, synthetic truth, foreign formats
     4  rectification    perspective, stereo and panoramic views
     3  cameras          protocol, one file for each model, registry
     2  geometry         rigid motions, rotations, planes, triangulation
     1  core | optim     errors, arrays, boards, detections, matches, clouds, truth | least squares, robust scale
     0  kernels          compiled loops

Conventions: `b_from_a` maps a to b, `x_in_a` is in frame a, adjacent names match. Camera x is right, y down, z forward;
pixel (0, 0) is the centre of the top-left pixel. `x2.T @ F21 @ x1 = 0`, `d2 ~ A21 @ d1`. Lengths are in mm. Angles are
in radians in the API, in degrees in files and reports.

>>> import numpy as np, rigkit
>>> cam2_from_cam1 = rigkit.Rigid3(np.eye(3), [-300.0, 0.0, 0.0])
>>> float(np.linalg.norm(cam2_from_cam1.translation_mm))
300.0
"""

from __future__ import annotations

import importlib
import logging
import re
from functools import cache

logging.getLogger(__name__).addHandler(logging.NullHandler())


@cache
def _homes() -> dict[str, str]:
    """Return the module of each public name, from `__init__.pyi`."""
    from pathlib import Path

    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    return {name: module for module, name in re.findall(r"^from (\S+) import (\w+)", stub, re.MULTILINE)}


def __getattr__(name: str) -> object:
    """Import a public name on first use, which keeps `import rigkit` and `rigkit --help` fast."""
    found: object
    if name == "__all__":
        found = sorted(_homes())
    elif name == "__version__":
        from importlib.metadata import version

        found = version("rigkit")
    elif name in _homes():
        found = getattr(importlib.import_module(_homes()[name]), name)
    else:
        raise AttributeError(f"module 'rigkit' has no attribute '{name}'")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return [*_homes(), "__all__", "__version__"]
