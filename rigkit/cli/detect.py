"""`rigkit detect`: every chessboard of every image, to a corners file and pictures."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.core.errors import CheckFailed, InputError

if TYPE_CHECKING:
    from rigkit.cameras.base import Camera
    from rigkit.core.boards import Board
    from rigkit.core.detections import BoardDetection

    How = tuple[list[Board], Camera | None, int]
    """Boards, camera and the smallest number of corners: the same for all images."""

HELP = "corners of every chessboard in the images, to a corners file and overlay pictures"

IMAGE_ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", nargs="+", metavar="IMAGE|FOLDER", help="images, or folders of images")
    parser.add_argument(
        "--board", action="append", default=[], metavar="BOARD.toml", help="a board that may be there; repeat for more"
    )
    parser.add_argument(
        "--camera",
        metavar="CALIBRATION.json",
        help="the camera of all images: finds corners that were missed on the boards given, and places all more finely",
    )
    parser.add_argument("-o", "--output", metavar="CORNERS.csv", help="write the corners file")
    parser.add_argument("--overlay", metavar="DIR", help="write a picture of each image with its corners")
    parser.add_argument(
        "--min-corners",
        type=int,
        default=12,
        metavar="N",
        help="fewest corners of a board whose size is not given (12)",
    )
    parser.add_argument("-j", "--jobs", type=int, metavar="N", help="processes (default: one a core)")
    parser.add_argument("--force", action="store_true", help="replace existing files")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.console import print_json
    from rigkit.detection.detect import MIN_BOARD_CORNERS
    from rigkit.io.board_file import load_board
    from rigkit.io.corners_file import write_corners
    from rigkit.io.files import ensure_writable

    if args.min_corners < MIN_BOARD_CORNERS:
        raise InputError(
            f"--min-corners {args.min_corners}: a chessboard of less than 3x3 corners cannot be told apart"
        )
    if args.jobs is not None and args.jobs < 1:
        raise InputError(f"--jobs {args.jobs}: at least one process is needed")
    images = list(_images(args.images))
    boards = [load_board(path) for path in args.board]
    camera = _camera(args.camera, boards)
    overlays = _overlay_paths(images, args.overlay)
    outputs = [*([args.output] if args.output else []), *filter(None, overlays)]
    ensure_writable(outputs, force=args.force, inputs=[*images, *args.board, *([args.camera] if args.camera else [])])
    found = _detect_all(images, overlays, (boards, camera, args.min_corners), args)
    if not any(found.values()):
        raise CheckFailed(f"no chessboard found in {len(images)} images; check focus and exposure, or --min-corners")
    if args.output:
        write_corners(args.output, found, force=args.force)
    if args.json:
        print_json({image: [_summary(item) for item in items] for image, items in found.items()})
        return 0
    for image, items in found.items():
        print(f"{image}: " + (", ".join(_words(item) for item in items) or "no board"))
    missing = sum(not items for items in found.values())
    print(f"{sum(map(len, found.values()))} boards in {len(images) - missing} of {len(images)} images")
    return 0


def _camera(path: str | None, boards: list[Board]) -> Camera | None:
    from rigkit.io.calibration_file import load_camera

    if path is None:
        return None
    if not boards:
        raise InputError("--camera helps to find boards of known size only; give them, such as --board a9x6.toml")
    return load_camera(path)


def _images(paths: list[str]) -> Iterator[Path]:
    seen: set[Path] = set()
    for name in paths:
        path = Path(name)
        inside = [path]
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_ENDINGS)
            if not inside:
                raise InputError(f"folder '{path}' has no images ({' '.join(sorted(IMAGE_ENDINGS))}); give another")
        elif not path.exists():
            raise InputError(f"image '{path}' does not exist; check the path")
        for image in inside:
            if image not in seen:
                seen.add(image)
                yield image


def _overlay_paths(images: list[Path], folder: str | None) -> list[Path | None]:
    """Return where each overlay goes; images of one name in several folders get their folder's name as well."""
    if folder is None:
        return [None] * len(images)
    common = Counter(image.stem for image in images)
    names = [image.stem if common[image.stem] == 1 else "_".join(image.with_suffix("").parts[-3:]) for image in images]
    if len(set(names)) < len(names):
        raise InputError("--overlay: several images would get the same picture name; run the folders one by one")
    return [Path(folder) / f"{name}.png" for name in names]


def _detect_all(
    images: list[Path], overlays: list[Path | None], how: How, args: argparse.Namespace
) -> dict[str, tuple[BoardDetection, ...]]:
    """Return the detections per image in the order of `images`, whatever the number of processes."""
    from rigkit.cli.console import progress_on_stderr
    from rigkit.core.processes import worker_pool

    progress = progress_on_stderr()
    tasks = [(image, overlay, how, args.force) for image, overlay in zip(images, overlays, strict=True)]
    jobs = min(args.jobs or os.cpu_count() or 1, len(images))
    found: dict[str, tuple[BoardDetection, ...]] = {}

    def collect(results: Any) -> None:
        for image, result in zip(images, results, strict=True):
            found[str(image)] = result
            progress("detecting", len(found), len(images))

    if jobs == 1:
        collect(map(detect_one, tasks))
    else:
        with worker_pool(jobs) as pool:
            collect(pool.map(detect_one, tasks, chunksize=max(1, min(8, len(tasks) // (4 * jobs)))))
    return found


def detect_one(task: tuple[Path, Path | None, How, bool]) -> tuple[BoardDetection, ...]:
    """Detect the boards of one image and write its overlay; at module level for other processes to find."""
    import cv2

    from rigkit.detection.detect import detect_boards
    from rigkit.io.files import write_atomic
    from rigkit.io.images import read_image
    from rigkit.report.overlay import draw_boards

    path, overlay, (boards, camera, min_corners), force = task
    cv2.setNumThreads(1)
    image = read_image(path)
    size = (image.shape[1], image.shape[0])
    if camera is not None and size != camera.size_px:
        raise InputError(
            f"image '{path}' is {size[0]}x{size[1]} px but the calibration is for {camera.size_px[0]}x"
            f"{camera.size_px[1]}; use that camera's images, or leave --camera out"
        )
    try:
        found = detect_boards(image, boards, min_corners=min_corners, camera=camera)
    except InputError as error:
        raise InputError(f"'{path}': {error}") from error
    if overlay is not None:
        picture = cv2.cvtColor(draw_boards(image, found), cv2.COLOR_RGB2BGR)
        write_atomic(overlay, cv2.imencode(".png", picture)[1].tobytes(), force=force)
    return found


def _words(found: BoardDetection) -> str:
    import numpy as np

    name = f"{found.board_id} " if found.board_id else ""
    sigma = float(np.median(found.sigma_px))
    return f"{name}{found.columns}x{found.rows} {len(found.grid)} corners +-{sigma:.3f} px"


def _summary(found: BoardDetection) -> dict[str, Any]:
    return {
        "board": found.board_id,
        "columns": found.columns,
        "rows": found.rows,
        "grid": found.grid.tolist(),
        "pixels": found.pixels.tolist(),
        "sigma_px": found.sigma_px.tolist(),
    }
