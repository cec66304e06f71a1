"""Calls of the library with arguments that make no sense, and readers that need more than a path, for `fuzz.py`."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_mutations import strange_arrays
from fuzz_seeds import SIZE_PX, small_cloud, small_detection

import rigkit
from rigkit.core.boards import Board
from rigkit.core.errors import RigkitError
from rigkit.interop.ocamcalib import read_py_ocamcalib
from rigkit.io.corners_file import read_corners
from rigkit.io.reading import read_text
from rigkit.io.truth_csv import load_truth_csv

SMALL = Board("small", 5, 4, 30.0, 30.0)
NUMBERS = (float("nan"), float("inf"), -float("inf"), 0, -1, 1e300, -1e300, 1e-320, 0.5, 10**30, 2**63)

Call = tuple[Callable[..., object], dict[str, Any]]


def read_vnl(path: Path) -> None:
    """Read corners of mrgingham, which are about one board."""
    read_corners(path, [SMALL])


def read_truth(path: Path) -> None:
    """Read a truth table about boards that are there."""
    load_truth_csv(path, {"first": (Board("wall", 5, 4, 30.0, 30.0), Board("floor", 5, 4, 30.0, 30.0))})


def read_py_ocam(path: Path) -> None:
    """Read a camera of py-OCamCalib."""
    read_py_ocamcalib(read_text(path), (640, 480), str(path))


def _calls() -> list[Call]:
    """Return functions with good arguments; one of them is then spoilt."""
    d, cloud = small_detection(), small_cloud()
    cameras = [
        rigkit.camera_model(name)((640, 480), np.array(p))
        for name, p in (
            ("pinhole", [400.0, 400.0, 320.0, 240.0]),
            ("brown", [420.0, 421.0, 320.0, 240.0, -0.28, 0.07, 2e-4, 1.7e-5]),
            ("kannala_brandt", [190.0, 190.0, 320.0, 240.0, 0.01, -0.005, 0.001, 0.0]),
            ("ucm", [190.0, 190.0, 320.0, 240.0, 0.6]),
            ("eucm", [190.0, 190.0, 320.0, 240.0, 0.6, 1.1]),
            ("double_sphere", [190.0, 190.0, 320.0, 240.0, -0.2, 0.6]),
            ("scaramuzza", [190.0, -1.2e-3, 4e-7, -1e-9, 320.0, 240.0, 1.0, 0.0]),
        )
    ]
    n = len(d.pixels)
    points = np.column_stack([np.linspace(-1, 1, n), np.linspace(1, -1, n), np.linspace(1, 2, n)])
    image = np.random.default_rng(0).integers(0, 255, SIZE_PX[::-1]).astype(float)
    calls: list[Call] = []
    for c in cameras:
        calls += [
            (c.project, {"points": points}),
            (c.unproject, {"pixels": d.pixels}),
            (c.project_with_jacobians, {"points": points}),
            (type(c), {"size_px": np.array([640, 480]), "parameters": c.parameters}),
        ]
    directions = np.tile(np.eye(2), (n, 1, 1))
    calls += [
        (rigkit.Board, {"board_id": "a", "columns": 5, "rows": 4, "square_x_mm": 30.0, "square_y_mm": 30.0}),
        (
            rigkit.BoardDetection,
            {k: getattr(d, k) for k in ("board_id", "columns", "rows", "grid", "pixels", "sigma_px")},
        ),
        (rigkit.OrientedCloud, {k: getattr(cloud, k) for k in type(cloud).__slots__}),
        (rigkit.Rigid3, {"rotation": np.eye(3), "translation": np.array([1.0, 2.0, 3.0])}),
        (rigkit.Rigid3.from_matrix, {"matrix": np.eye(4)}),
        (rigkit.compare_cameras, {"a": cameras[0], "b": cameras[1], "grid": np.array([20, 15])}),
        (rigkit.detect_boards, {"image": image, "boards": [SMALL], "min_corners": 12}),
        (rigkit.complete_boards, {"image": image, "detections": [d], "boards": [SMALL]}),
        (rigkit.rectify_map, {"camera": cameras[1], "target": cameras[0], "target_from_cam": np.eye(3)}),
        (rigkit.DirectionPairs, {"directions1": directions, "directions2": directions, "valid": np.ones((n, 2), bool)}),
        (rigkit.normals_from_affines, {"J1": np.ones((n, 2, 3)), "J2": np.ones((n, 2, 3)), "A21": directions}),
    ]
    return calls


def run_case(seed: int, number: int) -> None:
    """Run one call with one argument spoilt; what is refused in words (RigkitError) is well."""
    rng = random.Random(f"{seed}/api/{number}")
    function, arguments = rng.choice(_calls())
    spoilt = dict(arguments)
    kinds = [k for k, v in arguments.items() if isinstance(v, np.ndarray | int | float)]
    key = rng.choice(kinds)
    value = arguments[key]
    spoilt[key] = rng.choice(strange_arrays(value) if isinstance(value, np.ndarray) else NUMBERS)
    try:
        result = function(**_positional(function, spoilt))
        if isinstance(result, rigkit.OrientedCloud):
            with tempfile.TemporaryDirectory() as folder:
                rigkit.write_ply(Path(folder) / "cloud.ply", result)
                rigkit.read_ply(Path(folder) / "cloud.ply")
    except RigkitError:
        return
    except Exception as error:
        name = getattr(function, "__qualname__", str(function))
        shown = np.array2string(np.asarray(spoilt[key]), threshold=6)[:200].replace("\n", " ")
        shape = np.shape(spoilt[key])
        raise type(error)(f"{name}({key}={shown}, shape {shape}): {error}") from error


def _positional(function: Callable[..., object], arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments under the names that the function has for them, in order."""
    import inspect

    names = [p.name for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_KEYWORD]
    known = {k: v for k, v in arguments.items() if k in names}
    rest = iter([n for n in names if n not in known])
    return {**known, **{next(rest): v for k, v in arguments.items() if k not in names}}
