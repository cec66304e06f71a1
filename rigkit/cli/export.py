"""`rigkit export`: convert cameras and rigs between formats; clouds to PLY, npz, LAS, of a data set also to COLMAP.

examples:
  rigkit export calibration.json -o camera.yaml --to opencv
  rigkit export rig.json -o camchain.yaml --to kalibr
  rigkit export rig.json -o rig --to ros --names left right
  rigkit export rig.json -o left.txt --to ocamcalib --names left      one camera of a rig
  rigkit export camchain.yaml -o camera.json --to rigkit      import the file of another tool
  rigkit export lab -p first -o cloud.ply
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import add_options, file_path, options_of, progress_on_stderr, require_existing, size_of_words
from rigkit.cli.dataset_arguments import add_planes_argument
from rigkit.core.errors import InputError
from rigkit.workflows.inputs.formats import CAMERA_FORMATS, CLOUD_FORMATS, PLY_FORMATS, READ_FORMATS
from rigkit.workflows.options.cameras import ExportCameraOptions
from rigkit.workflows.options.clouds import ExportCloudOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", type=Path, metavar="SOURCE", help="a camera file, a rig, a cloud as PLY, or a data set (then --pair)"
    )
    # A text, as only that of a COLMAP model may end as folders do.
    parser.add_argument("-o", "--output", required=True, help="file to write (a folder for a COLMAP model)")
    parser.add_argument(
        "--to", choices=sorted({*CAMERA_FORMATS, *CLOUD_FORMATS}), help="format of OUTPUT (default: by its ending)"
    )
    parser.add_argument(
        "--from",
        dest="source_format",
        choices=READ_FORMATS,
        help="format of a camera file SOURCE (default: by its content)",
    )
    parser.add_argument("--names", nargs="+", metavar="CAMERA", help="cameras of a rig, in this order (default: all)")
    parser.add_argument("--size", metavar="WxH", help="image size, px, if SOURCE does not state it")
    add_options(parser, ExportCloudOptions, pair="-p", method="")
    add_planes_argument(parser, "points and normals of a pair")
    add_options(parser, ExportCloudOptions, single_precision="--float", force="")


def run(args: argparse.Namespace) -> int:
    is_cloud = args.source.is_dir() or args.source.suffix in (".toml", ".ply")
    try:
        args.output = Path(args.output) if is_cloud and args.to in (None, "colmap") else file_path(args.output)
    except argparse.ArgumentTypeError as error:
        raise InputError(f"export: -o/--output: {error}") from error
    if is_cloud:
        return _export_cloud(args)
    if args.single_precision:
        raise InputError("export: --float is for clouds written as PLY; leave it out")
    require_existing(args.source)
    import numpy as np

    from rigkit.core.printing import digits
    from rigkit.rectification.targets import field_across
    from rigkit.workflows.inputs.camera_files import is_rig
    from rigkit.workflows.outputs.export_camera import export_camera, export_rig

    size_px = None if args.size is None else size_of_words(args.size)
    passed_on = {"kind": args.to, "source_kind": args.source_format, "size_px": size_px}
    options = options_of(ExportCameraOptions, args, **passed_on)
    if args.source_format is None and is_rig(args.source):
        rig = export_rig(args.source, options, tuple(args.names or ()))
        print(f"{', '.join(map(str, rig.written))}: {rig.kind}, at most {digits(rig.max_error_px)} px from the input")
        return 0
    done = export_camera(args.source, options)
    if done.kind == "rigkit":
        across = np.degrees(field_across(done.camera))
        width, height = done.camera.size_px
        print(f"{args.output}: {done.camera.model}, {width}x{height} px, sees {across:.1f} degrees across")
    else:
        print(f"{args.output}: {done.kind}, at most {digits(done.max_error_px)} px from the input")
    return 0


def _export_cloud(args: argparse.Namespace) -> int:
    from rigkit.workflows.reconstruction.export_cloud import export_cloud, export_ply

    kind = args.to or args.output.suffix.lstrip(".") or "colmap"
    is_ply = args.source.suffix == ".ply"
    known = PLY_FORMATS if is_ply else CLOUD_FORMATS
    if kind not in known:
        what = "a PLY" if is_ply else "a cloud"
        raise InputError(f"export: {what} is written as {', '.join(known)}, not as '{kind}'; use --to")
    if args.single_precision and kind != "ply":
        raise InputError(f"export: --float is for clouds written as PLY, not as '{kind}'; leave it out")
    unused = {"--names": args.names, "--size": args.size, "--from": args.source_format}
    unused |= {"--pair": is_ply and args.pair, "--planes": is_ply and args.planes}
    if (option := next((name for name, given in unused.items() if given), None)) is not None:
        raise InputError(f"export: {option} does not apply to {'a PLY' if is_ply else 'a cloud'}; leave it out")
    options = options_of(ExportCloudOptions, args, kind=kind)
    if is_ply:
        print(f"{args.output}: {len(export_ply(args.source, options))} points")
        return 0
    r = export_cloud(args.source, options, progress=progress_on_stderr())
    print(f"{args.output}: {len(r.cloud)} points of pair '{r.pair_id}'")
    return 0
