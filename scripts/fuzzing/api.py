"""Calls of the library with invalid arguments, for `fuzz.py`."""

from __future__ import annotations

import contextlib
import functools
import random
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import rigkit
from fuzzing.mutations import strange_arrays
from fuzzing.seeds import SIZE_PX, small_cloud, small_detection
from rigkit.affine.correspondences import Correspondences
from rigkit.core.boards import Board
from rigkit.core.errors import RigkitError

SMALL = Board("small", 5, 4, 30.0, 30.0)
NUMBERS = (float("nan"), float("inf"), -float("inf"), 0, -1, 1e300, -1e300, 1e-320, 0.5, 10**30, 2**63)

Call = tuple[Callable[..., object], dict[str, Any]]


PARAMETERS = {
    "pinhole": [400.0, 400.0, 320.0, 240.0],
    "brown": [420.0, 421.0, 320.0, 240.0, -0.28, 0.07, 2e-4, 1.7e-5],
    "kannala_brandt": [190.0, 190.0, 320.0, 240.0, 0.01, -0.005, 0.001, 0.0],
    "ucm": [190.0, 190.0, 320.0, 240.0, 0.6],
    "eucm": [190.0, 190.0, 320.0, 240.0, 0.6, 1.1],
    "double_sphere": [190.0, 190.0, 320.0, 240.0, -0.2, 0.6],
    "scaramuzza": [190.0, -1.2e-3, 4e-7, -1e-9, 320.0, 240.0, 1.0, 0.0],
}
"""A camera of each model, 640 x 480 px."""


def _calls() -> list[Call]:
    """Return functions with good arguments; one of them is then spoilt."""
    d, cameras = small_detection(), [rigkit.camera_model(m)((640, 480), np.array(p)) for m, p in PARAMETERS.items()]
    n = len(d.pixels)
    points = np.column_stack([np.linspace(-1, 1, n), np.linspace(1, -1, n), np.linspace(1, 2, n)])
    return [
        *(call for camera in cameras for call in _calls_of_camera(camera, d, points)),
        *_calls_of_objects(cameras, d),
        *_calls_of_pairs(cameras, d, points),
    ]


def _calls_of_camera(c: rigkit.Camera, d: rigkit.BoardDetection, points: Any) -> list[Call]:
    return [
        (c.project, {"points": points}),
        (c.unproject, {"pixels": d.pixels}),
        (c.project_with_jacobians, {"points": points}),
        (type(c), {"size_px": np.array([640, 480]), "parameters": c.parameters}),
    ]


def _directions(n: int) -> dict[str, Any]:
    """Return the arguments of `DirectionPairs` for `n` points."""
    axes = np.tile(np.eye(2), (n, 1, 1))
    return {"image1": axes, "image2": axes, "valid": np.ones((n, 2), bool), "kinds": ("horizontal", "vertical")}


def _calls_of_objects(cameras: list[rigkit.Camera], d: rigkit.BoardDetection) -> list[Call]:
    """Return calls on boards, clouds, poses, cameras and images."""
    cloud, n = small_cloud(), len(d.pixels)
    image = np.random.default_rng(0).integers(0, 255, SIZE_PX[::-1]).astype(float)
    of_detection = ("board_id", "columns", "rows", "grid", "pixels", "sigma_px")
    return [
        (rigkit.Board, {"board_id": "a", "columns": 5, "rows": 4, "square_x_mm": 30.0, "square_y_mm": 30.0}),
        (rigkit.BoardDetection, {k: getattr(d, k) for k in of_detection}),
        (rigkit.OrientedCloud, {k: getattr(cloud, k) for k in type(cloud).__slots__}),
        (rigkit.Rigid3, {"rotation": np.eye(3), "translation": np.array([1.0, 2.0, 3.0])}),
        (rigkit.Rigid3.from_matrix, {"matrix": np.eye(4)}),
        (rigkit.compare_cameras, {"a": cameras[0], "b": cameras[1], "grid": np.array([20, 15])}),
        (rigkit.detect_boards, {"image": image, "boards": [SMALL], "min_corners": 12}),
        (rigkit.complete_boards, {"image": image, "detections": [d], "boards": [SMALL]}),
        (rigkit.rectify_map, {"camera": cameras[1], "target": cameras[0], "target_from_cam": np.eye(3)}),
        (rigkit.DirectionPairs, _directions(n)),
        (
            rigkit.normals_from_affines,
            {"J1": np.ones((n, 2, 3)), "J2": np.ones((n, 2, 3)), "A21": _directions(n)["image1"]},
        ),
    ]


def _calls_of_pairs(cameras: list[rigkit.Camera], d: rigkit.BoardDetection, points: Any) -> list[Call]:
    """Return calls on matches, affinities, views of a board and rectified images."""
    n, A21 = len(d.pixels), _directions(len(d.pixels))["image1"]
    sigmas: dict[str, Any] = {"sigma1_px": d.sigma_px, "sigma2_px": d.sigma_px}
    affine = {"A21": A21, "sigma_A": d.sigma_px}
    matches = rigkit.Matches.from_cameras(cameras[0], cameras[0], d.pixels, d.pixels * 1.1 + 2.0, **sigmas, **affine)
    remap, pose = rigkit.rectify_map(cameras[1], cameras[0]), rigkit.Rigid3(np.eye(3), np.array([1.0, 2.0, 3.0]))
    pairs = rigkit.DirectionPairs(**_directions(n), pixels1=d.pixels, pixels2=d.pixels)
    given = {"pixels1": d.pixels, "pixels2": d.pixels * 1.1, **sigmas, **affine}
    view = {"image": "a", "board": SMALL, "grid": d.grid, "pixels": d.pixels, "sigma_px": d.sigma_px}
    plane = {"K1": np.eye(3), "K2": np.eye(3), "normal": np.array([0.0, 0.0, 1.0]), "offset_mm": 900.0}
    compared = functools.partial(rigkit.compare_cameras, cameras[0], cameras[1], grid=(20, 15))
    return [
        (functools.partial(rigkit.Matches.from_cameras, cameras[0], cameras[1]), given),
        (matches.select, {"which": np.arange(4)}),
        (matches.with_affinities, affine),
        (Correspondences, {k: given[k] for k in ("pixels1", "pixels2", "A21", "sigma_A")} | {"sigma_px": d.sigma_px}),
        (functools.partial(rigkit.affines_from_directions, pairs), {"method": "F2UDIR", "F21": np.eye(3)}),
        (functools.partial(rigkit.affines_from_mixed_directions, pairs), {"scaled": np.ones((n, 2), bool)}),
        (rigkit.affines_from_homography, {"H21": np.eye(3), "pixels1": d.pixels}),
        (rigkit.homography_from_affines, {"pixels1": d.pixels, "pixels2": d.pixels, "A21": A21}),
        (functools.partial(rigkit.homography_from_plane, cam2_from_cam1=pose), plane),
        (_calibrated, {"model": "pinhole", **view}),
        (pose.apply, {"points": points}),
        (remap.pixels, {"pixels": d.pixels}),
        (remap.source_pixels, {"pixels": d.pixels}),
        (remap.image, {"image": np.zeros((480, 640)), "interpolation": "linear", "fill": 0.0}),
        (compared, {"mask": np.ones((15, 20), bool), "weights": np.ones((15, 20))}),
        (functools.partial(_solved, matches), {"weights": np.ones(n)}),
        (rigkit.BoardView, view),
    ]


def _calibrated(model: str, image: str, board: Board, grid: Any, pixels: Any, sigma_px: Any) -> None:
    """Calibrate from four views, one of which is spoilt."""
    d = small_detection()
    good = rigkit.BoardView("0", SMALL, d.grid, d.pixels, d.sigma_px)
    views = [replace(good, image=str(k), pixels=good.pixels * (1.0 + 0.1 * k)) for k in range(3)]
    views.append(rigkit.BoardView(image, board, grid, pixels, sigma_px))
    rigkit.calibrate(views, (640, 480), model=model, board="flat", folds=0)


def _solved(matches: rigkit.Matches, weights: Any) -> None:
    """Every linear solver with weights."""
    for kind in ("general", "planar", "standard", "forward"):
        with contextlib.suppress(RigkitError):
            rigkit.fundamental_for(kind).solve(matches, weights=weights)


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
        name = getattr(getattr(function, "func", function), "__qualname__", "a call")
        where = traceback.extract_tb(error.__traceback__)[-1]
        shown = np.array2string(np.asarray(spoilt[key]), threshold=6)[:200].replace("\n", " ")
        shape = np.shape(spoilt[key])
        raise AssertionError(
            f"{name}({key}={shown}, shape {shape}): {type(error).__name__}: {error} ({where.filename}:{where.lineno})"
        ) from error


def _positional(function: Callable[..., object], arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments under the names that the function has for them, in order."""
    import inspect

    names = [p.name for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_KEYWORD]
    known = {k: v for k, v in arguments.items() if k in names}
    rest = iter([n for n in names if n not in known])
    return {**known, **{next(rest): v for k, v in arguments.items() if k not in names}}
