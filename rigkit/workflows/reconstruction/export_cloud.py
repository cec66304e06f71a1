"""`rigkit export` of clouds: the oriented cloud of a pair, or of a PLY file, in other formats."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import InputError
from rigkit.core.progress import Progress, silent
from rigkit.interop.colmap_model import colmap_model
from rigkit.interop.las import las_bytes
from rigkit.io.disk.writing import ensure_writable, npz_bytes
from rigkit.io.manifests.manifest import Dataset, load_dataset
from rigkit.io.ply import ply_bytes, ply_unit, read_ply
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.workflows.options.clouds import ExportCloudOptions
from rigkit.workflows.outputs.results import write_results
from rigkit.workflows.reconstruction.datasets import load_cameras
from rigkit.workflows.reconstruction.pairs import match_images, reconstruct_with, with_calibration_sigmas

_log = logging.getLogger(__name__)


def export_cloud(
    dataset: Dataset | str | Path, options: ExportCloudOptions, *, progress: Progress = silent
) -> Reconstruction:
    """Reconstruct one pair of a data set, write its cloud, and return the reconstruction.

    The cloud is that of `reconstruct_dataset` with the same options; its sigmas include those of the calibrations.

    Raises InputError: no such pair, or several pairs and none selected; a file that cannot be read or written;
    DegenerateError: the corners do not determine the pose.
    """
    known = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    if options.pair is None and len(known.pairs) != 1:
        raise InputError(f"export: say which pair with --pair: {', '.join(p.pair_id for p in known.pairs)}")
    pair = known.pair(options.pair) if options.pair else known.pairs[0]
    if options.kind != "colmap":
        ensure_writable(options.output, force=options.force, inputs=known.inputs)
    pair.require_images()
    camera1, camera2 = load_cameras(known.select([pair.pair_id]), progress=progress).of(pair)
    matched, image1, _ = match_images(pair, camera1.near, camera2.near, "raw")
    r = reconstruct_with(matched, pair, options.method, image1)
    r = with_calibration_sigmas(r, options.planes or pair.planes, camera1, camera2)
    folder, files = options.output, dict[str, str | bytes]()
    if options.kind == "colmap":
        model, notes = colmap_model(
            (r.camera1, r.camera2),
            r.cam2_from_cam1,
            (r.pixels1, r.pixels2),
            r.cloud,
            (pair.image1, pair.image2),
            error_px=r.sampson_rms_px,
        )
        files |= model
        for words in notes:
            _log.info(words)
    else:
        folder = options.output.parent
        files[options.output.name] = _cloud_npz(r) if options.kind == "npz" else _cloud_bytes(r.cloud, options)
    write_results(folder, files, force=options.force, inputs=known.inputs)
    return r


def export_ply(source: Path, options: ExportCloudOptions) -> OrientedCloud:
    """Write the cloud of a PLY file in another format, and return it.

    Raises InputError for a file that cannot be read or written.
    """
    ensure_writable(options.output, force=options.force, inputs=(source,))
    cloud = read_ply(source)
    unit = ply_unit(source)
    content = npz_bytes(_cloud_arrays(cloud, unit)) if options.kind == "npz" else _cloud_bytes(cloud, options, unit)
    files: dict[str, str | bytes] = {options.output.name: content}
    write_results(options.output.parent, files, force=options.force, inputs=(source,))
    return cloud


def _cloud_npz(reconstruction: Reconstruction) -> bytes:
    """Return an npz file of points, normals, sigmas, corners, affinities and relative pose."""
    matches = reconstruction.matches
    arrays = _cloud_arrays(reconstruction.cloud, "mm") | {
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


def _cloud_arrays(cloud: OrientedCloud, unit: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a cloud by name; lengths are in `unit`, by which points and sigmas are named."""
    return {
        f"points_{unit}": cloud.points_mm,
        "normals": cloud.normals,
        "colours": cloud.colours,
        f"sigma_{unit}": cloud.sigma_mm,
        "normal_sigma_rad": cloud.normal_sigma_rad,
        "calibration_in_sigmas": np.array(cloud.calibration_in_sigmas),
        "board_index": cloud.board_index,
        "grid": cloud.grid,
        "board_ids": np.array(cloud.board_ids),
    }


def _cloud_bytes(cloud: OrientedCloud, options: ExportCloudOptions, unit: str = "mm") -> bytes:
    if options.kind == "las":
        return las_bytes(cloud, unit)
    return ply_bytes(cloud, single_precision=options.single_precision, unit=unit)
