"""`rigkit mesh`: the screened Poisson surface of an oriented cloud."""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import options_of, print_json, progress_on_stderr
from rigkit.core.errors import ExitCode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cloud", type=Path, metavar="CLOUD.ply", help="as `rigkit reconstruct` writes it, or any other")
    parser.add_argument("-o", "--output", type=Path, metavar="MESH.ply", help="default: CLOUD-mesh.ply beside it")
    parser.add_argument("--depth", type=int, default=9, help="of the octree: 2^N cells a side (default 9)")
    parser.add_argument(
        "--cut", type=float, default=0.02, metavar="SHARE", help="of the surface, where points are fewest (default .02)"
    )
    parser.add_argument(
        "--one-view",
        action=argparse.BooleanOptionalAction,
        help="all was seen from the origin, as from a pair of images: nothing hangs between near and far (default: as "
        "the file's header says)",
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the result for programs")


def run(args: argparse.Namespace) -> int:
    from rigkit.workflows.reconstruction.mesh import MeshOptions, mesh_cloud

    output = args.output or args.cloud.parent / f"{args.cloud.stem}-mesh.ply"
    options = options_of(MeshOptions, args, output=output)
    mesh = mesh_cloud(args.cloud, options, progress=progress_on_stderr())
    if args.json:
        print_json({"mesh": str(output), "vertices": len(mesh.points), "triangles": len(mesh.triangles)})
    else:
        print(f"{output}: {len(mesh.points)} vertices, {len(mesh.triangles)} triangles")
    return ExitCode.WELL
