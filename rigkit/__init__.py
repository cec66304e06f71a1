"""rigkit: cameras, rigs and reconstructions that are right.

Layers, each importing only rows below it (tests/test_architecture.py reads the imports)::

    12  cli              one module a verb: parse, call a workflow, print
    11  workflows        what a verb does: typed options in, typed results out, no printing
    10  report | coach   figures, pages, tables in Markdown, CSV and LaTeX | a guided capture on a local page
     9  io               manifests, sessions, calibration and corner files, PLY, images
     8  validation | study   against what was measured | synthetic studies
     7  reconstruction | planning        from detections, or correspondences, to a cloud | which picture to take next
     6  detection | identification   from an image to grids of corners | which board is which
     5  affine | relative_pose | calibration | synthetic | interop     estimators, truth to test them, foreign formats
     4  rectification    perspective, stereo and panoramic views
     3  cameras          protocol, one file a model, registry
     2  geometry         rigid motions, rotations, planes, triangulation
     1  core | optim     errors, arrays, boards, detections, matches, clouds, truth | least squares, robust scale
     0  kernels          compiled loops

Conventions: `b_from_a` maps a to b, `x_in_a` lives in a, touching names match. Camera x is right, y down, z forward;
pixel (0, 0) is the centre of the top-left pixel. `x2.T @ F21 @ x1 = 0`, `d2 ~ A21 @ d1`. Lengths are in mm; angles are
radians inside, degrees in files and reports.

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
    """Return the module of each public name, as `__init__.pyi` has them."""
    from pathlib import Path

    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    return {name: module for module, name in re.findall(r"^from (\S+) import (\w+)", stub, re.MULTILINE)}


def __getattr__(name: str) -> object:
    """Import public names on first use, so that `import rigkit` and `rigkit --help` stay quick."""
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
