"""Arrays as npz, and a reconstruction: for numpy, without loss."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.reconstruction.reconstruct import Reconstruction


def cloud_npz(reconstruction: Reconstruction) -> bytes:
    """Return an npz file: points, normals, sigmas, corners, affinities and the relative pose, units in the names."""
    cloud, matches = reconstruction.cloud, reconstruction.matches
    arrays: dict[str, NDArray[Any]] = {
        "points_mm": cloud.points_mm,
        "normals": cloud.normals,
        "colours": cloud.colours,
        "sigma_mm": cloud.sigma_mm,
        "normal_sigma_rad": cloud.normal_sigma_rad,
        "board_index": cloud.board_index,
        "grid": cloud.grid,
        "board_ids": np.array(cloud.board_ids),
        "pixels1": reconstruction.pixels1,
        "pixels2": reconstruction.pixels2,
        "cam2_from_cam1": reconstruction.cam2_from_cam1.matrix(),
        "E21": reconstruction.E21,
    }
    if matches.A21 is not None:
        arrays["A21"] = matches.A21
    if reconstruction.pose_covariance is not None:
        arrays["pose_covariance"] = reconstruction.pose_covariance
    return npz_bytes(arrays)


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return an npz file of these arrays."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()
