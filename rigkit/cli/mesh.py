"""`rigkit mesh`: mesh an oriented point cloud by screened Poisson reconstruction."""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import options_of, print_json, progress_on_stderr
from rigkit.core.errors import ExitCode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "cloud",
        type=Path,
        metavar="CLOUD.ply",
        help="point cloud with normals, of `rigkit reconstruct` or any other program",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="MESH.ply", help="default: CLOUD-mesh.ply beside it")
    parser.add_argument("--depth", type=int, default=9, help="depth of the octree: 2^DEPTH cells per side (default 9)")
    parser.add_argument(
        "--cut",
        type=float,
        default=0.02,
        metavar="SHARE",
        help="part of the surface to cut off where points are sparsest (default .02)",
    )
    parser.add_argument(
        "--one-view",
        action=argparse.BooleanOptionalAction,
        help="all points were seen from the origin: build no surface between foreground and background (default: as "
        "the header of CLOUD.ply says)",
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


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
