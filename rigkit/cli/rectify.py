"""`rigkit rectify`: an image as an ideal camera would have taken it, or two whose rows correspond."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.core.errors import InputError

if TYPE_CHECKING:
    from rigkit.rectification.rectify import RectifyMap

HELP = "perspective, cylindrical or equirectangular image from any camera's image, or a stereo pair"

EIGHT_BIT = (".jpg", ".jpeg", ".bmp", ".webp")

IMAGE_SIZE = re.compile(r"^(\d+)[xX](\d+)$")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("image", metavar="IMAGE", help="an image as the camera took it")
    parser.add_argument(
        "image2", metavar="IMAGE2", nargs="?", help="taken at once by another camera of the rig: stereo"
    )
    parser.add_argument("--camera", metavar="CALIB", help="the camera's calibration.json")
    parser.add_argument("-o", "--output", required=True, metavar="OUT", help="the image to write (.png, .tif, .jpg)")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="the result for programs, on stdout")
    stereo = parser.add_argument_group("stereo", "writes OUT-1 and OUT-2, in which a point has the same row")
    stereo.add_argument("--rig", metavar="RIG", help="the rig's file, instead of --camera")
    stereo.add_argument(
        "--names", nargs=2, metavar=("ONE", "TWO"), help="cameras of the two images (default: the rig's first two)"
    )
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
    if args.image2 is not None or args.rig is not None:
        return _run_stereo(args)
    import numpy as np

    from rigkit.io.calibration_file import load_camera
    from rigkit.io.files import ensure_writable
    from rigkit.rectification.rectify import rectify_map, rotation_from_view_angles
    from rigkit.rectification.targets import target_camera

    if args.camera is None:
        raise InputError("rectify: --camera is missing; give the camera's calibration.json")
    _ensure_kind(args.output)
    ensure_writable(args.output, force=args.force, inputs=(args.image, args.camera))
    camera = load_camera(args.camera)
    target = target_camera(
        camera,
        args.projection,
        hfov_rad=None if args.hfov_deg is None else np.radians(args.hfov_deg),
        size_px=_size(args.size),
    )
    rotation = rotation_from_view_angles(*np.radians([args.yaw_deg, args.pitch_deg, args.roll_deg]))
    return _report(args, [_write(args, args.image, rectify_map(camera, target, target_from_cam=rotation), args.output)])


def _run_stereo(args: argparse.Namespace) -> int:
    from rigkit.io.files import ensure_writable
    from rigkit.io.rig_file import load_rig
    from rigkit.rectification.stereo import rectify_pair

    if args.image2 is None or args.rig is None:
        raise InputError("rectify: a stereo pair needs two images and --rig RIG.json")
    _ensure_kind(args.output)
    if args.hfov_deg is not None or args.size is not None or args.yaw_deg or args.pitch_deg or args.roll_deg:
        raise InputError("rectify: the baseline decides the view of a stereo pair; leave out its angles and its size")
    rig = load_rig(args.rig)
    names = list(args.names or list(rig)[:2])
    missing = [name for name in names if name not in rig]
    if missing or len(names) != 2:
        raise InputError(f"'{args.rig}': no camera '{', '.join(missing)}'; there are {', '.join(rig)}")
    (camera1, cam1_from_rig), (camera2, cam2_from_rig) = (rig[name] for name in names)
    out = Path(args.output)
    outputs = [str(out.with_name(f"{out.stem}-{i}{out.suffix}")) for i in (1, 2)]
    ensure_writable(outputs, force=args.force, inputs=(args.image, args.image2, args.rig))
    pair = rectify_pair(camera1, camera2, cam2_from_rig @ cam1_from_rig.inverse(), projection=args.projection)
    images, maps = (args.image, args.image2), (pair.map1, pair.map2)
    done = [_write(args, image, remap, o) for image, remap, o in zip(images, maps, outputs, strict=True)]
    return _report(args, done, {"rect2_from_rect1_mm": pair.rect2_from_rect1.translation_mm.tolist()})


def _write(args: argparse.Namespace, image: str, remap: RectifyMap, output: str) -> dict[str, Any]:
    """Resample, write, and return what to say of it."""
    from rigkit.io.files import write_atomic
    from rigkit.io.images import read_image

    covered = float(remap.coverage().mean())
    if covered == 0.0:
        raise InputError("rectify: the camera sees nothing of this view; change --yaw-deg, --pitch-deg or --hfov-deg")
    pixels = remap.image(read_image(image), interpolation=args.interpolation)
    write_atomic(output, _encoded(pixels, output), force=args.force)
    target = remap.target
    return {
        "image": output,
        "projection": args.projection,
        "model": target.model,
        "size_px": list(target.size_px),
        "parameters": dict(zip(target.parameter_names(), target.parameters.tolist(), strict=True)),
        "target_from_cam": remap.target_from_cam.tolist(),
        "covered": covered,
    }


def _report(args: argparse.Namespace, done: list[dict[str, Any]], stereo: dict[str, Any] | None = None) -> int:
    from rigkit.cli.console import print_json

    if args.json:
        print_json(done[0] if stereo is None else {"images": done, **stereo})
        return 0
    for one in done:
        (width, height), focal = one["size_px"], one["parameters"]["fx"]
        print(
            f"{one['image']}: {one['projection']}, {width} x {height} px, focal length {focal:.2f} px, "
            f"{100.0 * one['covered']:.1f} % of it seen by the camera"
        )
    if stereo is not None:
        print(f"baseline {abs(stereo['rect2_from_rect1_mm'][0]):.3f} mm along the rows")
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
    if suffix in EIGHT_BIT and pixels.dtype != np.uint8:
        raise InputError(f"'{path}': a {suffix} file has no 16-bit pixels; write a .png or .tif")
    _, data = cv2.imencode(suffix, pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1]))
    return bytes(data)


def _ensure_kind(path: str) -> None:
    """Refuse a kind of image that cannot be written, before the work."""
    import cv2

    if not cv2.haveImageWriter(path):
        kind = Path(path).suffix
        raise InputError(f"'{path}': images of the kind '{kind}' cannot be written; take .png, .tif or .jpg")
