"""Other calibration programs behind one interface: OpenCV, mrcal, Ceres through pycolmap.

mrcal is Debian's (apt-get install mrcal python3-mrcal) and runs in Debian's Python, timed in its own process.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from rigkit.calibration.solving.state import State
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.detections import BoardView

DEBIAN_PYTHON = "/usr/bin/python3"
MRCAL_WORKER = Path(__file__).with_name("mrcal_worker.py")


class Mrcal:
    """mrcal on views by (frame, camera), started once; a context manager. `warp`: the board may be bent, and outliers
    are left out, as mrcal-calibrate-cameras does."""

    def __init__(
        self,
        views: Mapping[tuple[int, int], BoardView],
        size_px: tuple[int, int],
        model: str = "LENSMODEL_OPENCV5",
        *,
        warp: bool = False,
    ) -> None:
        self._views, self._size_px, self._model, self._warp = views, size_px, model, warp
        self.last: dict[str, Any] = {}

    @staticmethod
    def available() -> bool:
        """Say whether Debian's mrcal is installed."""
        try:
            found = subprocess.run([DEBIAN_PYTHON, "-c", "import mrcal"], capture_output=True, check=False)
        except FileNotFoundError:
            return False
        return found.returncode == 0

    def __enter__(self) -> Mrcal:
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name) / "corners.npz"
        keys = sorted(self._views)
        board = self._views[keys[0]].board
        frames = {frame: i for i, frame in enumerate(dict.fromkeys(frame for frame, _ in keys))}
        observations = np.full((len(keys), board.rows, board.columns, 3), -1.0)
        for k, key in enumerate(keys):
            view = self._views[key]
            observations[k, view.grid[:, 1], view.grid[:, 0], :2] = view.pixels
            observations[k, view.grid[:, 1], view.grid[:, 0], 2] = 1.0
        frame_camera = np.array([(frames[frame], camera) for frame, camera in keys], dtype=np.int32)
        np.savez(
            path,
            observations=observations,
            frame_camera=frame_camera,
            spacing=board.square_x_mm,
            size=self._size_px,
            model=np.array(self._model),
            warp=np.array(self._warp),
        )
        environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        self._process = subprocess.Popen(
            [DEBIAN_PYTHON, str(MRCAL_WORKER), str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        return self

    def run(self, hold_out: Sequence[int] = ()) -> float:
        """Calibrate once, without the frames `hold_out`, by number; the answer is in `last`."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps({"hold_out": list(hold_out)}) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError("mrcal gave up; its message is above")
        self.last = json.loads(answer)
        return float(self.last["seconds"])

    def cameras(self) -> list[Camera]:
        """Return the cameras of the last run."""
        return [Brown(self._size_px, np.array(one)) for one in self.last["intrinsics"]]

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        self._folder.cleanup()


def opencv_points(views: list[BoardView], dtype: type = np.float32) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [v.points().astype(dtype)[None] for v in views], [v.pixels.astype(dtype)[None] for v in views]


def opencv_regular(views: list[BoardView], size_px: tuple[int, int]) -> tuple[float, Camera]:
    objects, images = opencv_points(views)
    rms, K, d, _, _ = cv2.calibrateCamera([o[0] for o in objects], [i[0] for i in images], size_px, None, None)
    return rms, Brown(size_px, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d.ravel()[:5]]))


def opencv_fisheye(
    views: list[BoardView], size_px: tuple[int, int], guess: np.ndarray | None = None
) -> tuple[float, Camera]:
    """As in its documentation: extrinsics recomputed in each iteration, no skew. Without the former it ends anywhere.

    `guess` is K where there is one.
    """
    objects, images = opencv_points(views, np.float64)
    flags = fisheye_flag("RECOMPUTE_EXTRINSIC") | fisheye_flag("FIX_SKEW")
    if guess is not None:
        flags |= fisheye_flag("USE_INTRINSIC_GUESS")
    K0 = np.eye(3) if guess is None else guess.copy()
    rms, K, d, _, _ = cv2.fisheye.calibrate(objects, images, size_px, K0, np.zeros((4, 1)), flags=flags)
    return rms, KannalaBrandt(size_px, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d.ravel()[:4]]))


def fisheye_flag(name: str) -> int:
    """Return a flag of cv2.fisheye: OpenCV 5 has moved them out of that module."""
    return int(getattr(cv2.fisheye, f"CALIB_{name}", None) or getattr(cv2, f"CALIB_{name}"))


def opencv_omnidir(views: list[BoardView], size_px: tuple[int, int]) -> float:
    """Return the RMS, infinite where views were dropped."""
    objects, images = opencv_points(views, np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-8)
    # Its stubs know no None, which asks it to make the arrays.
    omnidir: Any = cv2.omnidir
    rms, *_, used = omnidir.calibrate(objects, images, size_px, None, None, None, 0, criteria)
    return float(rms) if np.size(used) == len(views) else np.inf


def opencv_multiview(
    views: dict[str, list[tuple[str, BoardView]]], size_px: tuple[int, int], frames: int
) -> list[np.ndarray]:
    """Return the mounts' translations by cv2.calibrateMultiview, mm."""
    seen = {name: dict(own) for name, own in views.items()}
    used = [str(f) for f in range(frames) if any(str(f) in own for own in seen.values())]
    board = next(iter(views.values()))[0][1].board
    blank = np.full((board.corner_count, 2), -1.0, np.float32)
    pixels = [[own[f].pixels.astype(np.float32) if f in own else blank for f in used] for own in seen.values()]
    mask = np.array([[255 * (f in own) for f in used] for own in seen.values()], dtype=np.uint8)
    # In squares: it takes a board in mm for a line.
    objects3 = [(board.points() / board.square_x_mm).astype(np.float32)] * len(used)
    sizes = [size_px] * len(seen)
    pinhole = np.zeros(len(seen), np.uint8)
    untyped: Any = cv2
    *_, T = untyped.calibrateMultiview(objects3, pixels, sizes, mask, pinhole, None, None, None, None)
    return [np.ravel(t) * board.square_x_mm for t in T]


def colmap_model(pycolmap: ModuleType, views: list[BoardView], start: State) -> Any:
    """Return a pycolmap reconstruction of the views at the start: one camera, the board's corners as fixed points."""
    model = pycolmap.Reconstruction()
    width, height = start.camera.size_px
    parameters = start.camera.parameters.copy()
    parameters[2:4] += 0.5
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="OPENCV_FISHEYE", width=width, height=height, params=parameters.tolist())
    )
    for k, view in enumerate(views):
        image = pycolmap.Image(name=f"{k}", keypoints=view.pixels + 0.5, camera_id=1, image_id=k + 1)
        pose = np.column_stack([start.rotation[k], start.translation_mm[k]])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for j, point in enumerate(views[0].points()):
        track = pycolmap.Track()
        for k in range(len(views)):
            track.add_element(k + 1, j)
        model.add_point3D(point, track)
    return model


def colmap_poses(model: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the poses (R, t) of its images."""
    matrices = [model.images[k].cam_from_world().matrix() for k in sorted(model.images)]
    return [(m[:, :3], m[:, 3]) for m in matrices]


def colmap_adjuster(pycolmap: ModuleType, model: Any) -> Any:
    """Return Ceres' problem for the model, one thread: its `solve` refines camera and poses, the points stay."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = True
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    for point_id in model.points3D:
        config.add_constant_point(point_id)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
