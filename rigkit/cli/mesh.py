"""`rigkit mesh`: mesh an oriented point cloud by screened Poisson reconstruction.

examples:
  rigkit mesh scene/scene.ply
  rigkit mesh scene/scene.ply -o surface.ply --depth 10 --cut 0.05
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import add_options, file_path, options_of, print_json, progress_on_stderr
from rigkit.core.errors import ExitCode
from rigkit.workflows.options.clouds import MeshOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "cloud",
        type=Path,
        metavar="CLOUD.ply",
        help="point cloud with normals, of `rigkit reconstruct` or any other program",
    )
    parser.add_argument("-o", "--output", type=file_path, metavar="MESH.ply", help="default: CLOUD-mesh.ply beside it")
    add_options(parser, MeshOptions, depth="", cut="SHARE", one_view="", force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    from rigkit.workflows.reconstruction.mesh import mesh_cloud

    output = args.output or args.cloud.parent / f"{args.cloud.stem}-mesh.ply"
    options = options_of(MeshOptions, args, output=output)
    mesh = mesh_cloud(args.cloud, options, progress=progress_on_stderr())
    if args.json:
        print_json({"mesh": str(output), "vertices": len(mesh.points), "triangles": len(mesh.triangles)})
    else:
        print(f"{output}: {len(mesh.points)} vertices, {len(mesh.triangles)} triangles")
    return ExitCode.WELL
