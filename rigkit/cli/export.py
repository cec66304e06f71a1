"""`rigkit export`: cameras to and from other tools' formats; clouds as PLY, npz or a COLMAP model."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rigkit.cli.console import note
from rigkit.core.errors import InputError

if TYPE_CHECKING:
    from rigkit.cameras.base import Camera

HELP = "cameras in other tools' formats; clouds as PLY, npz or a COLMAP model"

CAMERA_FORMATS = ("rigkit", "opencv", "kalibr", "ros", "colmap", "ocamcalib", "mrcal")
CLOUD_FORMATS = ("ply", "npz", "colmap")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", type=Path, help="a camera file, a rig (as Kalibr's camchain), or a data set (then --pair)"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="file to write (a folder for a COLMAP model)")
    parser.add_argument(
        "--to", choices=sorted({*CAMERA_FORMATS, *CLOUD_FORMATS}), help="format (default: by the ending)"
    )
    parser.add_argument(
        "--from", dest="source_format", choices=CAMERA_FORMATS, default="rigkit", help="of a camera file"
    )
    parser.add_argument("-p", "--pair", help="pair of the data set whose cloud is exported")
    parser.add_argument("--method", default="3SDIR", help="affine estimator of the normals (default 3SDIR)")
    parser.add_argument("--force", action="store_true", help="replace existing files")


def run(args: argparse.Namespace) -> int:
    if args.source.is_dir() or args.source.suffix == ".toml":
        return _export_cloud(args)
    from rigkit.io.rig_file import is_rig_file

    return _export_rig(args) if is_rig_file(args.source) else _export_camera(args)


def _export_rig(args: argparse.Namespace) -> int:
    from rigkit.interop.kalibr import write_kalibr
    from rigkit.io.files import ensure_writable, write_atomic
    from rigkit.io.rig_file import load_rig

    if args.to != "kalibr":
        raise InputError(
            f"export: '{args.source}' is a rig, which goes out with --to kalibr; for other formats export the "
            f"calibrations of its cameras, beside it: {args.source.stem}-CAMERA.json"
        )
    ensure_writable(args.output, force=args.force, inputs=[args.source])
    rig = load_rig(args.source)
    chain = write_kalibr([camera for camera, _ in rig.values()], [pose for _, pose in rig.values()])
    write_atomic(args.output, chain.text, force=args.force)
    print(f"{args.output}: kalibr, at most {max(one.max_error_px for one in chain.cameras):.4g} px from the rig given")
    for k, (name, one) in enumerate(zip(rig, chain.cameras, strict=True)):
        note(f"cam{k} is '{name}'" + (f"; {one.note}" if one.note else ""))
    return 0


def _export_camera(args: argparse.Namespace) -> int:
    import numpy as np

    from rigkit.io.calibration_file import refuse_mirrored, save_camera
    from rigkit.io.files import ensure_writable, write_atomic
    from rigkit.rectification.targets import field_across

    kind = args.to or ("rigkit" if args.output.suffix == ".json" else None)
    if kind not in CAMERA_FORMATS:
        raise InputError(f"export: say the camera's format with --to, one of {', '.join(CAMERA_FORMATS)}")
    ensure_writable(args.output, force=args.force, inputs=[args.source])
    camera = _read_camera(args.source, args.source_format)
    refuse_mirrored(camera, args.source)
    if kind == "rigkit":
        save_camera(args.output, camera, force=args.force)
        across = np.degrees(field_across(camera))
        width, height = camera.size_px
        print(f"{args.output}: {camera.model}, {width}x{height} px, sees {across:.1f} degrees across")
        return 0
    text, worst_px, words = _written(camera, kind)
    write_atomic(args.output, text, force=args.force)
    print(f"{args.output}: {kind}, at most {worst_px:.4g} px from the camera given")
    if words:
        note(words)
    return 0


def _read_camera(path: Path, kind: str) -> Camera:
    from rigkit.interop.colmap_cameras import read_colmap_cameras
    from rigkit.interop.kalibr import read_kalibr
    from rigkit.interop.mrcal import read_cameramodel
    from rigkit.interop.ocamcalib import read_ocamcalib
    from rigkit.interop.opencv import read_opencv
    from rigkit.interop.ros import read_camera_info
    from rigkit.io.calibration_file import load_camera
    from rigkit.io.reading import read_text

    if kind == "rigkit":
        return load_camera(path)
    text, name = read_text(path, "camera file"), str(path)
    if kind == "kalibr":
        cameras, _ = read_kalibr(text, name)
        return _only(cameras, name)
    if kind == "colmap":
        return _only(tuple(read_colmap_cameras(text, name).values()), name)
    if kind == "mrcal":
        camera, _, worst = read_cameramodel(text, name)
        if worst > 0.0:
            note(f"the spline was refitted as '{camera.model}', at most {worst:.4g} px away")
        return camera
    if kind == "ocamcalib":
        return read_ocamcalib(text, name)[0]
    return read_opencv(text, name) if kind == "opencv" else read_camera_info(text, name)


def _only(cameras: tuple[Camera, ...], name: str) -> Camera:
    if len(cameras) != 1:
        raise InputError(f"'{name}' holds {len(cameras)} cameras; leave the one that you want in it")
    return cameras[0]


def _written(camera: Camera, kind: str) -> tuple[str, float, str]:
    """Return the file's text, its largest error in px, and what a user should know."""
    from rigkit.interop.colmap_cameras import write_colmap_cameras
    from rigkit.interop.kalibr import write_kalibr
    from rigkit.interop.mrcal import write_cameramodel
    from rigkit.interop.ocamcalib import write_ocamcalib
    from rigkit.interop.opencv import write_opencv
    from rigkit.interop.ros import write_camera_info

    if kind == "kalibr":
        chain = write_kalibr([camera])
        one = chain.cameras[0]
        return chain.text, one.max_error_px, one.note
    if kind == "colmap":
        text, lines = write_colmap_cameras({1: camera})
        return text, lines[1].max_error_px, lines[1].note
    write = {
        "opencv": write_opencv,
        "ros": write_camera_info,
        "ocamcalib": write_ocamcalib,
        "mrcal": write_cameramodel,
    }[kind]
    done = write(camera)
    return done.text, done.max_error_px, done.note


def _export_cloud(args: argparse.Namespace) -> int:
    from rigkit.cli.console import progress_on_stderr
    from rigkit.workflows.export_cloud import ExportCloudOptions, export_cloud

    kind = args.to or args.output.suffix.lstrip(".") or "colmap"
    if kind not in CLOUD_FORMATS:
        raise InputError(f"export: a cloud is written as {', '.join(CLOUD_FORMATS)}, not as '{kind}'; use --to")
    options = ExportCloudOptions(output=args.output, kind=kind, pair=args.pair, method=args.method, force=args.force)
    r = export_cloud(args.source, options, progress=progress_on_stderr())
    print(f"{args.output}: {len(r.cloud)} points of pair '{r.pair_id}'")
    return 0
