"""mrcal on corners from an .npz, in Debian's own Python: benchmark_calibration_peers.py starts it and asks for runs.

    /usr/bin/python3 scripts/mrcal_worker.py corners.npz

The .npz holds observations (N, rows, columns, 3) as mrcal has them, frame_camera (N, 2), the spacing in mm and the size
of the images. For each line on the standard input it calibrates once, in the stages of mrcal-calibrate-cameras (seed;
poses; poses and stereographic core; everything), without board warp or outlier rejection, and answers with a line of
JSON: CPU seconds, RMS in px per coordinate, intrinsics, mounts (rotation vector, mm).
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import mrcal
import numpy as np

MODEL = "LENSMODEL_OPENCV5"
START = 1e-6
"""Size of the distortion's random start, as in mrcal-calibrate-cameras."""


def calibrated(
    observations: np.ndarray, frame_camera: np.ndarray, spacing: float, size: list[int]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return intrinsics, extrinsics and the RMS per coordinate."""
    cameras = int(frame_camera[:, 1].max()) + 1
    sizes = np.tile(np.asarray(size, dtype=np.int32), (cameras, 1))
    observations = observations.copy()
    core, mounts, frames = mrcal.seed_stereographic(
        imagersizes=sizes,
        focal_estimate=float(max(size)),
        indices_frame_camera=frame_camera,
        observations=observations,
        object_spacing=spacing,
    )
    indices = np.concatenate([frame_camera, frame_camera[:, 1:] - 1], axis=1).astype(np.int32)
    inputs: dict[str, Any] = {
        "extrinsics_rt_fromref": mounts,
        "frames_rt_toref": frames,
        "points": None,
        "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": indices,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "imagersizes": sizes,
        "calibration_object_spacing": spacing,
        "do_optimize_calobject_warp": False,
        "do_apply_outlier_rejection": False,
    }
    for optimize_core in (False, True):
        mrcal.optimize(
            intrinsics=core,
            lensmodel="LENSMODEL_STEREOGRAPHIC",
            do_optimize_intrinsics_core=optimize_core,
            do_optimize_intrinsics_distortions=False,
            do_apply_regularization=False,
            **inputs,
        )
    count = mrcal.lensmodel_num_params(MODEL) - core.shape[1]
    distortion = START * np.random.default_rng(0).uniform(-1.0, 1.0, (cameras, count))
    intrinsics = np.concatenate([core, distortion], axis=1)
    stats = mrcal.optimize(intrinsics=intrinsics, lensmodel=MODEL, do_apply_regularization=True, **inputs)
    return intrinsics, mounts, stats["rms_reproj_error__pixels"]


def main() -> None:
    with np.load(sys.argv[1]) as given:
        problem = (given["observations"], given["frame_camera"], float(given["spacing"]), given["size"].tolist())
    for _ in sys.stdin:
        start = time.process_time()
        intrinsics, mounts, rms = calibrated(*problem)
        spent = time.process_time() - start
        answer = {"seconds": spent, "rms": rms, "intrinsics": intrinsics.tolist(), "mounts": mounts.tolist()}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
