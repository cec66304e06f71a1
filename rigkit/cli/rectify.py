"""`rigkit rectify`: undistort images to perspective, cylindrical or equirectangular views, or rectify a stereo pair."""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import add_options, note, options_of, print_json, progress_on_stderr, size_of_words
from rigkit.cli.rectification_output import grouped_by_description, image_to_dict
from rigkit.core.errors import ExitCode, InputError
from rigkit.workflows.options.cameras import RectifyOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("image", metavar="IMAGE|FOLDER|VIDEO", help="image as captured, a folder of images, or a video")
    parser.add_argument(
        "image2",
        metavar="IMAGE2|FOLDER2|VIDEO2",
        nargs="?",
        help="taken at the same time by another camera of the rig: rectifies a stereo pair",
    )
    parser.add_argument("--camera", metavar="CALIB", help="the camera's calibration.json")
    add_options(parser, RectifyOptions, output="-o OUT", maps="FILE.npz", force="")
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
    from rigkit.workflows.rectify import holds_several, rectify_image, rectify_stereo_images

    options = options_of(
        RectifyOptions,
        args,
        angles_deg=(args.yaw_deg, args.pitch_deg, args.roll_deg),
        size_px=None if args.size is None else size_of_words(args.size),
    )
    if args.image2 is None and args.rig is None:
        if args.camera is None:
            raise InputError("rectify: --camera is missing; give the camera's calibration.json")
        done = rectify_image(args.image, args.camera, options, progress=progress_on_stderr())
        found = [image_to_dict(one, args.projection) for one in done.images]
        result = {"images": found} if holds_several(args.image) else found[0]
    elif args.rig is None or (args.image2 is None and not Path(args.image).is_dir()):
        raise InputError("rectify: a stereo pair needs two images, or a folder of both cameras', and --rig RIG.json")
    else:
        names = None if args.names is None else tuple(args.names)
        both = args.image if args.image2 is None else (args.image, args.image2)
        done = rectify_stereo_images(both, args.rig, options, names, progress=progress_on_stderr())
        result = {"images": [image_to_dict(one, args.projection) for one in done.images]}
        if done.pair is not None:
            result["rect2_from_rect1_mm"] = done.pair.rect2_from_rect1.translation_mm.tolist()
    for error in done.failures.values():
        note(f"left out: {error}")
    if args.json:
        print_json(result)
    else:
        for words, images in grouped_by_description(done.images, args.projection):
            place = images[0] if len(images) == 1 else f"{images[0].parent}, {len(images)} images"
            print(f"{place}: {words}")
        if done.pair is not None:
            print(f"baseline {abs(done.pair.rect2_from_rect1.translation_mm[0]):.3f} mm along the rows")
    return ExitCode.BAD_INPUT if done.failures else ExitCode.WELL
