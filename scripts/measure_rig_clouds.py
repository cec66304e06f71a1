#!/usr/bin/env python3
"""Do clouds of one pair, by two calibrations of its rig from halves of its frames, agree within the sigmas?

    python scripts/measure_rig_clouds.py MM=FOLDER ... [--splits 3] [--pairs 3] [--seed 0]

FOLDER has images of two cameras that `rigkit calibrate FOLDER --square-mm MM` calibrates as a rig. Its frames are split
randomly into halves, and each half is calibrated. Pairs of images are grown into a cloud with both calibrations. Only
the calibrations (lenses, extrinsics, length of the baseline) differ, so only they change the range of a pixel. Printed
for each set: the median absolute difference of ranges, the same over the calibrations' part of the sigmas, and over the
sigmas with an exact rig. If sigmas are true, the second is 0.67 on average; a split is one common error of all points.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from rigkit.affine.features import match_affine_features
from rigkit.cameras.uncertain import UncertainPair
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import RigkitError
from rigkit.io.calibrations.rig_file import load_saved_rig
from rigkit.io.media.images import read_image
from rigkit.reconstruction.growing.dense import grow_scene
from rigkit.reconstruction.scene import reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose
from rigkit.workflows.calibration.calibrate_any import calibrate_folders
from rigkit.workflows.inputs.folder_session import cameras_in
from rigkit.workflows.options.cameras import CalibrateOptions, FolderOptions

Frame = tuple[Path, Path]


def frames_of(folder: Path) -> list[Frame]:
    """Return the images of both cameras that belong together: in the order of their names."""
    first, second = (
        sorted(path for place, pattern in images for path in place.glob(pattern))
        for images in cameras_in([folder]).values()
    )
    return list(zip(first, second, strict=True))


def rig_of(frames: list[Frame], square_mm: float) -> UncertainPair:
    """Return the rig that some frames show, as sure as its file says."""
    with tempfile.TemporaryDirectory() as place:
        folders = [Path(place, side) for side in ("left", "right")]
        for side, folder in enumerate(folders):
            folder.mkdir()
            for k, frame in enumerate(frames):
                (folder / f"{k:03d}{frame[side].suffix}").symlink_to(frame[side].resolve())
        output = Path(place, "rig.json")
        calibrate_folders(folders, FolderOptions(square_mm=square_mm), CalibrateOptions(output=output, report=None))
        known = load_saved_rig(output).quoted
    assert known is not None
    return known.pair(0, 1)


def ranges(frame: Frame, rig: UncertainPair) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return of every node of the first image the range, mm, its sigma by noise, and by calibrations; NaN where nothing
    grows."""
    images = [read_image(path) for path in frame]
    seeds = match_affine_features(*images)
    pose = KnownPose(rig.posed.cam2_from_cam1, moved=tuple(rig.moved()))
    sparse = reconstruct_scene(seeds, *rig.posed[:2], known_pose=pose, image1=images[0])
    dense = grow_scene(sparse, seeds, *images, pose_is_known=True, calibrations=rig)
    out = np.full((3, dense.surface.valid.size), np.nan)
    cloud, common = dense.scene.reconstruction.cloud, dense.of_calibrations[0]
    out[:, dense.nodes] = np.linalg.norm(cloud.points_mm, axis=1), np.sqrt(cloud.sigma_mm**2 - common**2), common
    return out[0], out[1], out[2]


def measure(folder: Path, square_mm: float, splits: int, pairs: int, rng: np.random.Generator) -> None:
    """Print how far apart clouds by halves are."""
    frames = frames_of(folder)
    rows = []
    for _ in range(splits):
        order = rng.permutation(len(frames))
        halves = [[frames[k] for k in own] for own in np.array_split(order, 2)]
        try:
            rigs = [rig_of(half, square_mm) for half in halves]
            for k in rng.choice(len(frames), min(pairs, len(frames)), replace=False):
                one, other = (ranges(frames[k], rig) for rig in rigs)
                off = np.abs(one[0] - other[0])
                by_noise, by_calibrations = (np.hypot(one[row], other[row]) for row in (1, 2))
                rows.append([np.nanmedian(v) for v in (off, off / by_calibrations, off / by_noise)])
        except RigkitError as error:
            print(f"{folder.name}: {error}")
    off, told, exact = np.median(rows, axis=0)
    print(
        f"{folder.name}, {len(frames)} frames, {len(rows)} pairs: ranges {off:.3f} mm apart, {told:.2f} sigmas of the "
        f"calibrations; {exact:.2f} sigmas if the rig were exact",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", metavar="MM=FOLDER")
    parser.add_argument("--splits", type=int, default=3)
    parser.add_argument("--pairs", type=int, default=3, help="pairs of images a split")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for one in args.sets:
        square_mm, _, folder = one.partition("=")
        measure(Path(folder), float(square_mm), args.splits, args.pairs, np.random.default_rng(args.seed))


if __name__ == "__main__":
    main()
