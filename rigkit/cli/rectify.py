"""`rigkit rectify`: undistort images to perspective, cylindrical or equirectangular views, or rectify a stereo pair.

examples:
  rigkit rectify photo.jpg --camera calibration.json -o straight.png
  rigkit rectify photos --camera calibration.json -o straight --crop      a whole folder
  rigkit rectify left right --rig rig.json -o rectified --maps maps.npz       rectified stereo pairs; K, P, Q, maps
  rigkit rectify photos --rig rig.json -o rectified          one folder of left01, right01, ...
  rigkit rectify fisheye.jpg --camera fisheye.json -o round.png --projection equirectangular
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.cli.console import add_options, note_left_out, options_of, print_json, require_existing, size_of_words
from rigkit.cli.progress import progress_on_stderr
from rigkit.core.errors import InputError
from rigkit.workflows.options.cameras import RectifyOptions

if TYPE_CHECKING:
    from rigkit.workflows.rectify import RectifiedImage


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "images",
        nargs="+",
        metavar="IMAGE|FOLDER|VIDEO",
        help="images as captured, folders or videos; with --rig of two cameras, taken at the same time",
    )
    parser.add_argument("--camera", metavar="CALIB", help="the camera's calibration.json")
    add_options(parser, RectifyOptions, output="-o OUT", maps="FILE.npz", frames="", force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    stereo = parser.add_argument_group(
        "stereo",
        "writes OUT/ONE/... and OUT/TWO/... (OUT-1 and OUT-2 of an image's name), whose corresponding points are in "
        "the same row",
    )
    stereo.add_argument("--rig", metavar="RIG", help="the rig's file, instead of --camera")
    stereo.add_argument(
        "--names",
        nargs=2,
        metavar=("ONE", "TWO"),
        help="cameras of the two images (default: those that their names say, else the rig's first two)",
    )
    view = parser.add_argument_group("view")
    add_options(view, RectifyOptions, projection="", hfov_deg="DEG")
    view.add_argument("--yaw-deg", type=float, default=0.0, metavar="DEG", help="look to the right")
    view.add_argument("--pitch-deg", type=float, default=0.0, metavar="DEG", help="look up")
    view.add_argument("--roll-deg", type=float, default=0.0, metavar="DEG", help="turn the view clockwise")
    view.add_argument(
        "--size", metavar="WxH", help="image size of the result, px (default: keeps the source's resolution)"
    )
    add_options(view, RectifyOptions, crop="", interpolation="")


def run(args: argparse.Namespace) -> int:
    require_existing(*args.images, args.camera, args.rig)
    from rigkit.workflows.rectify import holds_several, rectify_image, rectify_stereo_images

    options = options_of(
        RectifyOptions,
        args,
        angles_deg=(args.yaw_deg, args.pitch_deg, args.roll_deg),
        size_px=None if args.size is None else size_of_words(args.size),
    )
    if args.rig is None:
        if args.camera is None:
            raise InputError("rectify: give --camera CALIBRATION.json, or --rig RIG.json of a stereo pair")
        done = rectify_image(args.images, args.camera, options, progress=progress_on_stderr())
        found = [_figures(one, args.projection) for one in done.images]
        result = {"images": found} if holds_several(args.images) else found[0]
    elif len(args.images) > 2 or (len(args.images) == 1 and not Path(args.images[0]).is_dir()):
        raise InputError("rectify: --rig needs two images, folders or videos, or one folder of both cameras' images")
    else:
        names = None if args.names is None else tuple(args.names)
        both = tuple(args.images) if len(args.images) == 2 else args.images[0]
        done = rectify_stereo_images(both, args.rig, options, names, progress=progress_on_stderr())
        result = {"images": [_figures(one, args.projection) for one in done.images]}
        if done.pair is not None:
            result["rect2_from_rect1_mm"] = done.pair.rect2_from_rect1.translation_mm.tolist()
    code = note_left_out(done.failures.values())
    if args.json:
        print_json(result)
    else:
        alike: dict[tuple[Path, str], list[Path]] = {}
        for one in done.images:
            alike.setdefault((one.path.parent, _words(one, args.projection)), []).append(one.path)
        for (folder, words), images in alike.items():
            place = images[0] if len(images) == 1 else f"{folder}, {len(images)} images"
            print(f"{place}: {words}")
        if done.pair is not None:
            print(f"baseline {abs(done.pair.rect2_from_rect1.translation_mm[0]):.3f} mm along the rows")
    return code


def _figures(one: RectifiedImage, projection: str) -> dict[str, Any]:
    """Return a rectified image as JSON values."""
    from rigkit.io.calibrations.calibration_file import camera_to_json

    target = one.map.target
    return {
        "image": str(one.path),
        "projection": projection,
        **camera_to_json(target),
        "target_from_cam": one.map.target_from_cam.tolist(),
        "covered": one.covered,
    }


def _words(one: RectifiedImage, projection: str) -> str:
    target = one.map.target
    (width, height), focal = target.size_px, target.named(target.parameters)["fx"]
    return (
        f"{projection}, {width} x {height} px, focal length {focal:.2f} px, "
        f"{100.0 * one.covered:.1f} % of it seen by the camera"
    )
