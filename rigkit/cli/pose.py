"""`rigkit pose`: pose of a camera relative to one board in its image.

examples:
  rigkit pose floor.jpg --camera calibration.json --board 9x6x25
  rigkit pose floor.jpg --camera camera.yaml --board board.toml --json
"""

from __future__ import annotations

import argparse

from rigkit.cli.console import pose_in_words, print_json, require_existing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("image", metavar="IMAGE", help="an image that shows the board")
    parser.add_argument("--camera", required=True, metavar="CALIB", help="the camera's calibration")
    parser.add_argument("--board", required=True, metavar="CxRxMM|BOARD.toml", help="such as 9x6x25")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    require_existing(args.image, args.camera)
    import numpy as np

    from rigkit.workflows.handeye import camera_on_board

    placed = camera_on_board(args.image, args.camera, args.board)
    pose = placed.pose.cam_from_board
    sigmas = np.sqrt(np.diag(placed.pose.covariance))
    if args.json:
        figures = {"cam_from_board": pose.matrix()[:3].tolist(), "covariance": placed.pose.covariance.tolist()}
        print_json(
            {**figures, "rms_px": placed.rms_px, "ambiguous": placed.ambiguous, "board_measured": placed.board_measured}
        )
        return 0
    centre = pose.inverse().translation_mm
    print(pose_in_words("cam_from_board", pose, sigmas[:3], sigmas[3:]))
    print(f"camera centre in the board's frame: {centre[0]:.2f}, {centre[1]:.2f}, {centre[2]:.2f} mm")
    print(
        f"RMS {placed.rms_px:.3f} px"
        + ("; ambiguous: the board tilted the other way fits as well" if placed.ambiguous else "")
    )
    if placed.board_measured:
        print("the board's corners are where the calibration measured them, not flat as declared")
    if not placed.lens_known:
        print("the camera file has no covariance: the intrinsics are treated as exact")
    return 0
