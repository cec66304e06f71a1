"""`rigkit handeye`: hand-eye calibration: a camera on a robot hand, or fixed beside the robot, from board images.

examples:
  rigkit handeye poses.csv images --camera calibration.json --board board.toml -o hand-eye.json
  rigkit handeye poses.csv images --camera calibration.json --board board.toml --board-on-hand
"""

from __future__ import annotations

import argparse

from rigkit.cli.console import (
    add_options,
    note_left_out,
    options_of,
    pose_in_words,
    progress_on_stderr,
    require_existing,
)
from rigkit.workflows.options.cameras import HandEyeOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "poses", metavar="POSES.csv", help="image (or timestamp_ns),x_mm,y_mm,z_mm,qx,qy,qz,qw: base_from_hand"
    )
    parser.add_argument("images", metavar="IMAGES", nargs="+", help="images of the board, or a folder of them")
    add_options(parser, HandEyeOptions, camera="CALIB", board="CxRxMM|BOARD.toml", board_on_hand="", inverse="")
    add_options(parser, HandEyeOptions, output="-o FILE.json", force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    require_existing(args.poses, *args.images, args.camera)
    import numpy as np

    from rigkit.workflows.handeye import POSE_NAMES, calibrate_hand_eye, hand_eye_text

    options = options_of(HandEyeOptions, args)
    done = calibrate_hand_eye(args.poses, args.images, options, progress=progress_on_stderr())
    result = done.result
    code = note_left_out(done.unreadable)
    if args.json:
        print(hand_eye_text(result, options), end="")
        return code
    turns, moves = result.sigmas()
    first, second = POSE_NAMES[args.board_on_hand]
    print(pose_in_words(first, result.cam_from_mount, turns[0], moves[0]))
    print(pose_in_words(second, result.stand_from_board, turns[1], moves[1]))
    print(
        f"{len(result.image_rms_px)} images, RMS {result.rms_px:.3f} px; medians over the images: "
        f"{np.median(result.translation_residuals_mm):.2f} mm and "
        f"{np.degrees(np.median(result.rotation_residuals_rad)):.3f} deg between the board's pose in the image and by "
        "the robot"
    )
    print(
        f"the robot's poses err by {result.robot_move_mm:.2f} mm along and {np.degrees(result.robot_turn_rad):.3f} deg "
        "about each axis, as the scatter shows"
    )
    for image, mismatch in result.left_out.items():
        print(f"left out: '{image}' rotated differently from the robot, by {np.degrees(mismatch):.1f} degrees")
    for image, (turn, move) in result.contradicting.items():
        print(
            f"left out: the robot's pose of '{image}' is wrong by {move:.1f} mm and {np.degrees(turn):.2f} degrees, as "
            "all other images have it"
        )
    return code
