"""`rigkit reconstruct --images A B` and `--correspondences FILE`: pairs of views of any scene, without boards."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.cli.console import note, print_json, progress_on_stderr
from rigkit.cli.workflow import output_folder, read_for, write_results
from rigkit.core.errors import InputError

if TYPE_CHECKING:
    from rigkit.affine.correspondences import Correspondences

__all__ = ["add_scene_arguments", "is_scene", "run_scene"]

POSE_TYPES = ("general", "planar", "standard", "forward", "auto")


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("a textured scene without boards, instead of DATASET")
    group.add_argument("--images", nargs=2, metavar=("A", "B"), help="match affine features of these two images")
    group.add_argument(
        "--correspondences",
        metavar="FILE",
        help="CSV, NPZ or AffineExtractor text with affinities or directions; --images then colours the cloud",
    )
    group.add_argument("--camera", metavar="CALIB", help="calibration of the camera (of image A)")
    group.add_argument("--camera2", metavar="CALIB", help="calibration of the camera of image B (default: the same)")
    group.add_argument("--baseline-mm", type=float, metavar="MM", help="measured baseline (default: it is the unit)")
    group.add_argument("--pose-type", choices=POSE_TYPES, default="general", help="of the two views (default general)")
    group.add_argument("--level-sigma-deg", type=float, metavar="DEG", help="how well that pose type holds")


def is_scene(args: argparse.Namespace) -> bool:
    """Say whether a scene is asked for; raises InputError for both or neither of scene and data set."""
    scene = bool(args.images or args.correspondences)
    if scene == bool(args.dataset):
        raise InputError("reconstruct: give either a DATASET, or --images A B or --correspondences FILE with --camera")
    if scene and not args.camera:
        raise InputError(
            "reconstruct: a scene needs --camera CALIB, a calibration file such as `rigkit calibrate` writes"
        )
    return scene


def run_scene(args: argparse.Namespace) -> int:
    import numpy as np

    from rigkit.io.calibration_file import load_camera
    from rigkit.reconstruction.scene import reconstruct_scene

    name = Path(args.correspondences or args.images[0]).stem
    out = output_folder(args, name)
    camera1 = load_camera(args.camera)
    camera2 = load_camera(args.camera2) if args.camera2 else camera1
    images = None
    if args.images:
        images = (read_for(camera1, args.images[0], "image A"), read_for(camera2, args.images[1], "image B"))
        if np.array_equal(*images):
            raise InputError(
                f"images A '{args.images[0]}' and B '{args.images[1]}' are the same picture to the last pixel: no "
                "baseline; give two images taken from different places"
            )
    found = _correspondences(args, images)
    level = None if args.level_sigma_deg is None else float(np.deg2rad(args.level_sigma_deg))
    scene = reconstruct_scene(
        found,
        camera1,
        camera2,
        pair_id=name,
        pose_type=args.pose_type,
        level_sigma_rad=level,
        baseline_mm=args.baseline_mm,
        image1=images[0] if images else None,
    )
    r = scene.reconstruction
    unit = "mm" if scene.metric else "baselines"
    inputs = [path for path in (*(args.images or ()), args.correspondences, args.camera, args.camera2) if path]
    write_results(out, _files(args, scene, found, images), force=args.force, inputs=inputs)
    for words in r.notes:
        note(f"{name}: {words}")
    result: dict[str, Any] = {
        "output": str(out),
        "ply": "scene.ply",
        "pose_type": str(r.pose_type),
        "correspondences": len(found),
        "inliers": int(scene.inliers.sum()),
        "points": len(r.cloud),
        "unit": unit,
        "cam2_from_cam1": r.cam2_from_cam1.matrix().tolist(),
        "sigma_px": scene.sigma_px,
        "sigma_A": scene.sigma_A if np.isfinite(scene.sigma_A) else None,
        "sampson_rms_px": r.sampson_rms_px,
        "notes": list(r.notes),
    }
    if args.json:
        print_json(result)
    else:
        print(
            f"{out / 'scene.ply'}: {len(r.cloud)} points ({unit}) of {len(found)} correspondences, "
            f"{result['inliers']} of which agree, Sampson rms {r.sampson_rms_px:.3f} px, {r.pose_type}"
        )
    return 0


def _correspondences(args: argparse.Namespace, images: tuple[Any, Any] | None) -> Correspondences:
    if args.correspondences:
        from rigkit.io.correspondences import read_correspondences

        return read_correspondences(args.correspondences)
    from rigkit.affine.features import match_affine_features

    assert images is not None
    progress = progress_on_stderr()
    progress("matching affine features", 0, 1)
    found = match_affine_features(*images)
    progress("matching affine features", 1, 1)
    return found


def _files(
    args: argparse.Namespace, scene: Any, found: Correspondences, images: tuple[Any, Any] | None
) -> dict[str, str | bytes]:
    from rigkit.io.correspondences import correspondences_text
    from rigkit.io.ply import ply_bytes
    from rigkit.report.figures import cloud_png, epipolar_png
    from rigkit.report.scene_figure import normals_png

    r = scene.reconstruction
    unit = "mm" if scene.metric else "baselines"
    files: dict[str, str | bytes] = {"scene.ply": ply_bytes(r.cloud, unit=unit)}
    if not args.correspondences:
        files["correspondences.csv"] = correspondences_text(found)
    if args.no_pictures:
        return files
    files["cloud.png"] = cloud_png(r, unit=unit)
    if images:
        files["epipolar.png"] = epipolar_png(r, *images, every=max(1, len(r.cloud) // 40))
        files["normals.png"] = normals_png(scene, found, *images)
    return files
