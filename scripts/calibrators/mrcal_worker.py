"""mrcal on corners from an .npz, in Debian's own Python: peers.py starts it and asks for runs.

    /usr/bin/python3 scripts/calibrators/mrcal_worker.py corners.npz

The .npz holds observations (N, rows, columns, 3) as mrcal has them, frame_camera (N, 2), the spacing in mm, the size of
the images, the lens model, and whether the board may be warped and outliers be rejected, as mrcal-calibrate-cameras
does. Each line on the standard input is JSON: {"hold_out": [frames]}. It calibrates from the other frames in the stages
of mrcal-calibrate-cameras (seed; poses; poses and stereographic core; everything). It answers with a line of JSON: CPU
seconds, RMS in px per coordinate, intrinsics, mounts (rotation vector, mm), the board's corners. Of the frames held
out, with nothing but the board's pose refitted, follow the sum of squares in px^2 and the number of corners.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import mrcal
import numpy as np

START = 1e-6
"""Size of the distortion's random start, as in mrcal-calibrate-cameras."""


def calibrated(given: dict[str, Any], kept: np.ndarray) -> dict[str, Any]:
    """Return intrinsics, mounts, warp and RMS per coordinate from the observations `kept` (N,)."""
    model, warped = str(given["model"]), bool(given["warp"])
    frame_camera = given["frame_camera"][kept].copy()
    _, frame_camera[:, 0] = np.unique(frame_camera[:, 0], return_inverse=True)
    frame_camera = frame_camera.astype(np.int32)
    observations = given["observations"][kept].copy()
    size, spacing = given["size"].tolist(), float(given["spacing"])
    cameras = int(frame_camera[:, 1].max()) + 1
    sizes = np.tile(np.asarray(size, dtype=np.int32), (cameras, 1))
    core, mounts, frames = mrcal.seed_stereographic(
        imagersizes=sizes,
        focal_estimate=float(max(size)),
        indices_frame_camera=frame_camera,
        observations=observations,
        object_spacing=spacing,
    )
    inputs: dict[str, Any] = {
        "extrinsics_rt_fromref": mounts,
        "frames_rt_toref": frames,
        "points": None,
        "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": np.concatenate(
            [frame_camera, frame_camera[:, 1:] - 1], axis=1
        ).astype(np.int32),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "imagersizes": sizes,
        "calibration_object_spacing": spacing,
    }
    before = {"do_optimize_calobject_warp": False, "do_apply_outlier_rejection": False}
    for optimize_core in (False, True):
        mrcal.optimize(
            intrinsics=core,
            lensmodel="LENSMODEL_STEREOGRAPHIC",
            do_optimize_intrinsics_core=optimize_core,
            do_optimize_intrinsics_distortions=False,
            do_apply_regularization=False,
            **before,
            **inputs,
        )
    count = mrcal.lensmodel_num_params(model) - core.shape[1]
    distortion = START * np.random.default_rng(0).uniform(-1.0, 1.0, (cameras, count))
    if "SPLINED" in model:
        distortion[:] = 0.0
    intrinsics, warp = np.concatenate([core, distortion], axis=1), np.zeros(2)
    inputs |= {"intrinsics": intrinsics, "lensmodel": model, "do_apply_regularization": True}
    stages: list[dict[str, Any]] = [before]
    if warped:
        # Like the tool: everything but the warp, then the warp too, outliers left out.
        stages.append({"calobject_warp": warp, "do_optimize_calobject_warp": True, "do_apply_outlier_rejection": True})
    for stage in stages:
        core_of = {"do_optimize_intrinsics_core": "SPLINED" not in model}
        stats = mrcal.optimize(**core_of, **stage, **inputs)
    return {"intrinsics": intrinsics, "mounts": mounts, "warp": warp, "rms": stats["rms_reproj_error__pixels"]}


def held_out(given: dict[str, Any], found: dict[str, Any], test: np.ndarray) -> tuple[float, int]:
    """Return the squares and the count of the corners `test` (N,) of single cameras, the board's poses refitted."""
    if not test.any():
        return 0.0, 0
    model, spacing = str(given["model"]), float(given["spacing"])
    observations = given["observations"][test].copy()
    indices = np.stack([np.arange(len(observations)), np.zeros(len(observations))], axis=1).astype(np.int32)
    poses = mrcal.estimate_monocular_calobject_poses_Rt_tocam(
        indices, observations, spacing, [(model, found["intrinsics"][0])]
    )
    stats = mrcal.optimize(
        intrinsics=found["intrinsics"],
        extrinsics_rt_fromref=None,
        frames_rt_toref=mrcal.rt_from_Rt(poses),
        points=None,
        observations_board=observations,
        indices_frame_camintrinsics_camextrinsics=np.concatenate([indices, indices[:, 1:] - 1], axis=1).astype(
            np.int32
        ),
        observations_point=None,
        indices_point_camintrinsics_camextrinsics=None,
        imagersizes=np.asarray(given["size"], dtype=np.int32)[None],
        calibration_object_spacing=spacing,
        lensmodel=model,
        calobject_warp=found["warp"],
        do_optimize_calobject_warp=False,
        do_optimize_intrinsics_core=False,
        do_optimize_intrinsics_distortions=False,
        do_apply_outlier_rejection=False,
        do_apply_regularization=False,
    )
    seen = observations[..., 2].ravel() > 0.0
    squares = (np.asarray(stats["x"])[: 2 * seen.size].reshape(-1, 2) ** 2).sum(axis=-1)
    return float(squares[seen].sum()), int(seen.sum())


def main() -> None:
    with np.load(sys.argv[1]) as data:
        given = {name: data[name] for name in data}
    rows, columns = given["observations"].shape[1:3]
    for line in sys.stdin:
        out = np.isin(given["frame_camera"][:, 0], json.loads(line)["hold_out"])
        start = time.process_time()
        found = calibrated(given, ~out)
        spent = time.process_time() - start
        squares, count = held_out(given, found, out)
        board = mrcal.ref_calibration_object(columns, rows, float(given["spacing"]), calobject_warp=found["warp"])
        answer = {
            "seconds": spent,
            "rms": found["rms"],
            "intrinsics": found["intrinsics"].tolist(),
            "mounts": found["mounts"].tolist(),
            "board": board.reshape(-1, 3).tolist(),
            "squares": squares,
            "count": count,
        }
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
