"""`rigkit rectify`: an image as an ideal camera would have taken it."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from rigkit.errors import InputError

HELP = "perspective, cylindrical or equirectangular image from any camera's image"

IMAGE_SIZE = re.compile(r"^(\d+)[xX](\d+)$")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("image", metavar="IMAGE", help="an image as the camera took it")
    parser.add_argument("--camera", required=True, metavar="CALIB", help="the camera's calibration.json")
    parser.add_argument("-o", "--output", required=True, metavar="OUT", help="the image to write (.png, .tif, .jpg)")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="the result for programs, on stdout")
    view = parser.add_argument_group("view")
    view.add_argument("--projection", choices=("perspective", "cylindrical", "equirectangular"), default="perspective")
    view.add_argument("--hfov-deg", type=float, metavar="DEG", help="from the left edge to the right (default: suits)")
    view.add_argument("--yaw-deg", type=float, default=0.0, metavar="DEG", help="look to the right")
    view.add_argument("--pitch-deg", type=float, default=0.0, metavar="DEG", help="look up")
    view.add_argument("--roll-deg", type=float, default=0.0, metavar="DEG", help="turn the view clockwise")
    view.add_argument("--size", metavar="WxH", help="of the result, px (default: keeps the source's resolution)")
    view.add_argument(
        "--interpolation",
        choices=("spline", "lanczos", "linear", "nearest"),
        default="spline",
        help="spline (default) keeps positions to a thousandth of a pixel, linear is quick",
    )


def run(args: argparse.Namespace) -> int:
    import numpy as np

    from rigkit.cameras.rectify import rectify_map, rotation_from_view_angles
    from rigkit.cameras.targets import target_camera
    from rigkit.cli.console import print_json
    from rigkit.io.calibration_file import load_camera
    from rigkit.io.files import ensure_writable, write_atomic
    from rigkit.io.images import read_image

    ensure_writable(args.output, force=args.force)
    camera = load_camera(args.camera)
    target = target_camera(
        camera,
        args.projection,
        hfov_rad=None if args.hfov_deg is None else np.radians(args.hfov_deg),
        size_px=_size(args.size),
    )
    rotation = rotation_from_view_angles(*np.radians([args.yaw_deg, args.pitch_deg, args.roll_deg]))
    remap = rectify_map(camera, target, target_from_cam=rotation)
    covered = float(remap.coverage().mean())
    if covered == 0.0:
        raise InputError("rectify: the camera sees nothing of this view; change --yaw-deg, --pitch-deg or --hfov-deg")
    image = remap.image(read_image(args.image), interpolation=args.interpolation)
    write_atomic(args.output, _encoded(image, args.output), force=args.force)
    if args.json:
        result = {
            "image": args.output,
            "projection": args.projection,
            "size_px": list(target.size_px),
            "parameters": dict(zip(target.parameter_names(), target.parameters.tolist(), strict=True)),
            "target_from_cam": rotation.tolist(),
            "covered": covered,
        }
        print_json(result)
    else:
        width, height = target.size_px
        print(
            f"{args.output}: {args.projection}, {width} x {height} px, focal length {target.parameters[0]:.2f} px, "
            f"{100.0 * covered:.1f} % of it seen by the camera"
        )
    return 0


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = IMAGE_SIZE.match(text)
    if match is None:
        raise InputError(f"--size {text}: give width and height in px, such as --size 1280x960")
    return int(match[1]), int(match[2])


def _encoded(image: object, path: str) -> bytes:
    import cv2
    import numpy as np

    suffix = Path(path).suffix.lower()
    pixels = np.asarray(image)
    if suffix in (".jpg", ".jpeg") and pixels.dtype != np.uint8:
        raise InputError(f"'{path}': JPEG has no 16-bit pixels; write a .png or .tif")
    try:
        done, data = cv2.imencode(suffix, pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1]))
    except cv2.error:
        done = False
    if not done:
        raise InputError(f"'{path}': images of the kind '{suffix}' cannot be written; take .png, .tif or .jpg")
    return bytes(data)
