#!/usr/bin/env python3
"""Degrade whole sets of REAL images: is the board still identified, and the camera the same?

    python scripts/measure_worse_sets.py MM=FOLDER ... [--only "noise 8" "jpeg 30" ...]

Every image of a folder (of `--most` of them) is degraded in the same way, and the folder calibrated like `rigkit
calibrate FOLDER --square-mm MM`, without naming the board. Both calibrations are of the same camera and pictures, so
they must differ by less than `rigkit diff` predicts for new pictures. Prints for each set and degradation the board,
views used, camera model, held-out error, difference over its prediction, and the verdict, or the error message.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from compare_detection import images_of
from detectors.degradations import degraded, eight_bit

from rigkit.calibration.compare import CameraVerdict, compare_calibrations
from rigkit.calibration.result import Calibration
from rigkit.core.errors import RigkitError
from rigkit.io.boards.board_words import words_of_board
from rigkit.io.media.images import read_image
from rigkit.workflows.calibration.calibrate import SessionCalibration
from rigkit.workflows.calibration.calibrate_any import calibrate_folders
from rigkit.workflows.options.cameras import Cache, CalibrateOptions, FolderOptions

AS_IT_IS = "as it is"
WORSE = (
    *("noise 8", "gamma 1.8", "blur 2", "sharpened 1.2", "jpeg 30", "webcam 4", "motion 4", "inverted 1"),
    *("noise 15", "salt 5", "jpeg 10", "vignetting 0.03", "size 0.5", "turned 90", "mirrored 1"),
)
"""Name and amount, as in `detectors.degradations`."""

OTHER_PIXELS = ("size", "turned", "mirrored", "cut")
"""What moves pixels: another camera, which is not compared."""


def calibrated(folder: Path, square_mm: float) -> tuple[str, Calibration]:
    """Return the board that a folder of images shows, in words, and the camera."""
    options = CalibrateOptions(output=folder / "camera.json", cache=Cache.OFF)
    result = calibrate_folders([folder], FolderOptions(square_mm=square_mm), options)
    assert isinstance(result, SessionCalibration)
    return " + ".join(map(words_of_board, result.session.boards)), result.calibration


def rows(source: Path, square_mm: float, worse: list[str], most: int) -> Iterator[str]:
    """Yield a row of the table for every degradation of a set, of `most` of its images."""
    paths = images_of(source, None)
    images = {path.stem: eight_bit(read_image(path)) for path in paths[:: -(-len(paths) // most)]}
    first: Calibration | None = None
    for how in (AS_IT_IS, *worse):
        rng = np.random.default_rng(len(images))
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "images"
            folder.mkdir()
            for name, grey in images.items():
                kind, _, amount = how.partition(" ")
                image = grey if how == AS_IT_IS else eight_bit(degraded(kind, float(amount), grey, rng)[0])
                cv2.imwrite(str(folder / f"{name}.png"), image)
            try:
                words, own = calibrated(folder, square_mm)
            except RigkitError as error:
                yield f"{source.name} | {how} | {error}"
                continue
        heldout = "" if own.heldout_rms_px is None else f"{own.heldout_rms_px:.3f}"
        line = f"{source.name} | {how} | {words} | {len(own.views)} | {own.camera.model} | {heldout}"
        if how == AS_IT_IS:
            first = own
        elif first is not None and how.partition(" ")[0] not in OTHER_PIXELS:
            compared = compare_calibrations(first, own)
            same = "" if compared.verdict is CameraVerdict.SAME else f" {compared.verdict}"
            line += f" | {compared.ratio:.2f}{same}"
        yield line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", metavar="MM=FOLDER")
    parser.add_argument("--only", nargs="+", default=list(WORSE), metavar="NAME AMOUNT")
    parser.add_argument("--most", type=int, default=1000, metavar="N", help="images of a set, evenly spread")
    args = parser.parse_args()
    print("set | made worse | board | views | model | held out, px | difference over predicted")
    for item in args.sets:
        square_mm, _, folder = item.partition("=")
        for row in rows(Path(folder), float(square_mm), args.only, args.most):
            print(row)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
