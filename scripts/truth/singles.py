"""Single images of the table of truth: the number of AprilGrid tags found."""

from __future__ import annotations

from collections.abc import Iterator

import cv2

from rigkit.core.arrays import in_8_bits
from rigkit.detection.detect import detect_boards
from rigkit.io.media.images import read_image, to_grey
from truth.table import OPENCV, RIGKIT, Bench, Row


def aprilgrid(bench: Bench) -> Iterator[Row]:
    """Yield the tags found by rigkit's corners and by cv2.aruco's detector of the same family: seven images show 36
    tags, one shows 72, one 66."""
    ours = theirs = 0
    parameters = cv2.aruco.DetectorParameters()
    # Kalibr prints tags with a border of two modules.
    parameters.markerBorderBits = 2
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), parameters)
    paths = bench.images("*.png")
    for path in paths:
        image = in_8_bits(to_grey(read_image(path)))
        ours += sum(len(found.grid) for found in detect_boards(image, bench.found.described.boards)) // 4
        corners, _, _ = detector.detectMarkers(image)
        theirs += len(corners)
    how = f"{len(paths)} single images"
    yield bench.row("tags found", RIGKIT, float(ours), "", how=how)
    yield bench.row("tags found", OPENCV, float(theirs), "", how=how)
