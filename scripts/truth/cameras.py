"""Single cameras of the table of truth: held-out errors, and errors against measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.hand_eye import hand_eye
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.manifests.robot_poses import read_robot_poses
from rigkit.io.media.images import read_image
from truth import peers
from truth.resection import FOLDS, Fit, Size, Views, folds_of, held_out_rms, rms_of
from truth.table import MRCAL, RIGKIT, Bench, Row

HELD_OUT = "held-out rms"
MAX_RELEASED = 100
"""Corners of the largest board on which cv2.calibrateCameraRO is tried on images held out: it takes minutes for one of
160."""
CALIPER_CORNERS = {"a": (0, 0), "b": (15, 0), "c": (0, 9), "d": (15, 9)}
PEER_FAILURES = (RigkitError, cv2.error, RuntimeError, ValueError, np.linalg.LinAlgError)


def kept_views(found: Calibration, boards: Sequence[Board]) -> list[BoardView]:
    """Return the corners that rigkit kept, as it reads its boards. Boards seen in part, of which nothing tells which
    part, are left out."""
    known = {board.board_id: board for board in boards}
    out = []
    for view in found.views:
        if view.board_id not in known:
            continue
        board, kept = known[view.board_id], view.kept
        ones = np.ones(int(kept.sum()))
        out.append(BoardView(view.image, board, view.grid[kept], view.pixels[kept], ones))
    return out


def again(found: Calibration, size_px: Size) -> Callable[[Views], Fit]:
    """Return how rigkit fits some of the images with the model, the size and the board's shape that it chose of all."""
    model, kind = found.camera.model, found.boards[0].kind
    pupil = "central" if found.pupil is None else "moving"
    # Of models that come in several sizes the candidates' names tell the size, such as "scaramuzza 6".
    sizes = [c.name.partition(",")[0].split()[1:] for c in found.candidates if c.chosen and c.name.startswith(model)]
    degree = next((int(words[0]) for words in sizes if words and words[0].isdigit()), None)

    def fitted(views: Views) -> Fit:
        one = calibrate(views, size_px, model=model, degree=degree, board=kind, folds=0, pupil=pupil)
        return Fit(one.near, one.rms_px, one.boards[0].points_mm)

    return fitted


def pupil_words(found: Calibration) -> str:
    """Return what is to be said of a lens that does not look from one point."""
    return "" if found.pupil is None else " with a moving pupil"


def seen(count: int, total: int) -> str:
    """Return in words how many corners an error counts: one beyond a camera's field of view cannot be judged."""
    return f"{count} of {total} corners"


def compared(bench: Bench, found: Calibration, fisheye: bool) -> Iterator[Row]:
    """Yield each tool's error on images held out, all on the corners that rigkit kept."""
    views, size_px = kept_views(found, bench.found.described.boards), found.camera.size_px
    if len(views) < FOLDS:
        how = f"its own folds; boards seen in part, which no peer takes; {found.camera.model}"
        yield bench.row(HELD_OUT, RIGKIT, found.heldout_rms_px, how=how)
        return
    total = sum(len(view.grid) for view in views)
    rms, count = held_out_rms(views, again(found, size_px))
    about = f"{found.camera.model}{pupil_words(found)}, board {found.boards[0].kind}; {len(views)} images; "
    about += seen(count, total)
    yield bench.row(HELD_OUT, RIGKIT, rms, how=about)
    large = views[0].board.corner_count > MAX_RELEASED
    for peer, fit in peers.CAMERA_FITS.items():
        if large and peer == peers.RELEASED:
            continue
        try:
            rms, count = held_out_rms(views, partial(fit, size_px=size_px, fisheye=fisheye))
        except PEER_FAILURES as error:
            why = str(error).splitlines()[-1]
            print(f"{bench.name}: {peer}: {why}")
            if not peer.variant:
                yield bench.row(HELD_OUT, peer.tool, None, how=why)
            continue
        yield bench.row(HELD_OUT, peer.tool, rms, variant=peer.variant, how=seen(count, total))
    if peers.mrcal_takes(views[0].board):
        yield from mrcal_rows(bench, HELD_OUT, views, size_px, fisheye, folds_of(views))


def mrcal_rows(
    bench: Bench, quantity: str, views: Views, size_px: Size, fisheye: bool, folds: Sequence[Sequence[int]]
) -> Iterator[Row]:
    """Yield mrcal's error on images held out with its lean model, and of fisheye lenses with splines too."""
    lenses = {"OPENCV8": peers.MRCAL_LENS} | ({"splines": peers.MRCAL_FISHEYE} if fisheye else {})
    for variant, lens in lenses.items() if peers.mrcal_there() else ():
        try:
            rms: float | None = peers.mrcal_held_out(views, size_px, lens, folds)
        except PEER_FAILURES as error:
            rms = None
            print(f"{bench.name}: mrcal: {error}")
        yield bench.row(quantity, MRCAL, rms, variant=variant, how=lens)


def one_camera(pattern: str, fisheye: bool, published: str | None = None) -> Callable[[Bench], Iterator[Row]]:
    def rows(bench: Bench) -> Iterator[Row]:
        found = bench.alone(pattern).calibration
        yield from compared(bench, found, fisheye)
        if published is not None:
            yield bench.against(published, RIGKIT, found.rms_px)

    return rows


def caliper_board(bench: Bench) -> Iterator[Row]:
    found = bench.alone("*.png").calibration
    views, size_px = kept_views(found, bench.found.described.boards), found.camera.size_px
    yield from caliper_rows(bench, RIGKIT, f"board {found.boards[0].kind}", found.boards[0].points_mm)
    for peer, fit in peers.CAMERA_FITS.items():
        if peer.variant:
            points = fit(views, size_px, False).points_mm
            yield from caliper_rows(bench, peer.tool, peer.variant, points)
    if peers.mrcal_there():
        yield from caliper_rows(bench, MRCAL, "board warped", peers.mrcal_points(views, size_px))
    yield from compared(bench, found, False)


def caliper_rows(bench: Bench, tool: str, variant: str, points: np.ndarray | None) -> Iterator[Row]:
    """Yield the six distances after one scale (the side of the squares is nominal), and how many lie within 2 sigmas
    of the calipers alone: none of the tools states how sure a board's corners are."""
    assert points is not None
    columns = bench.board.columns
    at = {name: points[row * columns + column] for name, (column, row) in CALIPER_CORNERS.items()}
    pairs = list(combinations(sorted(at), 2))
    names = [a + b for a, b in pairs]
    lengths = np.array([np.linalg.norm(at[a] - at[b]) for a, b in pairs])
    known = [bench.measured(name) for name in names]
    truth = np.array([m.value for m in known])
    lengths *= (truth @ lengths) / (lengths @ lengths)
    error = lengths - truth
    more = {"variant": variant, "how": "after one scale: the squares are nominal"}
    rms = float(np.sqrt((error**2).mean()))
    yield bench.row("six distances, rms error", tool, rms, "mm", **more)
    inside = int((np.abs(error) <= 2.0 * np.array([m.sigma for m in known], dtype=float)).sum())
    yield bench.row("distances within 2 sigmas of the calipers, of 6", tool, float(inside), "", **more)


def simplestereo(bench: Bench) -> Iterator[Row]:
    """Yield the focal length of both cameras; of a lens without distortion all models that state fx mean the same."""
    for side in "LR":
        found = bench.alone(f"calib/*_{side}.png", side).calibration
        views, size_px = kept_views(found, bench.found.described.boards), found.camera.size_px
        one = calibrate(views, size_px, model="brown", board=found.boards[0].kind)
        focal, sigma = float(one.camera.parameters[0]), float(one.parameter_sigmas[0])
        yield bench.against("focal length", RIGKIT, focal, sigma, variant=f"brown, {side}")
        for peer, fit in peers.CAMERA_FITS.items():
            if not peer.variant:
                focal = float(fit(views, size_px, False).camera.parameters[0])
                yield bench.against("focal length", peer.tool, focal, variant=side)
        if peers.mrcal_there():
            yield bench.against("focal length", MRCAL, peers.mrcal_focal(views, size_px), variant=side)


def published_corners(path: Path, board: Board) -> BoardView:
    """Return the view of a file of published corners (*.orpc)."""
    lines = path.read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("encoding")) + 1
    table = np.array([[float(x) for x in line.split(",")] for line in lines[start:] if line.strip()])
    row, column = np.divmod(table[:, 1].astype(np.int64), board.columns)
    return BoardView(path.name, board, np.stack([column, row], -1), table[:, 3:5], np.full(len(table), 0.1))


def ov_plane(bench: Bench) -> Iterator[Row]:
    """Yield the error on the published test images from the published training images and corners."""
    train, test = (
        [published_corners(path, bench.board) for path in bench.found.files(f"corners/{part}/*.orpc")]
        for part in ("train", "test")
    )
    height, width = read_image(bench.found.files("corners/test/*.png")[0]).shape[:2]
    size_px = (width, height)
    total = sum(len(view.grid) for view in test)
    quantity = "rms on the published test images"
    for shape in ("flat", "auto"):
        found = calibrate(train, size_px, model=bench.model, board=shape)
        rms, count = rms_of(Fit(found.near, found.rms_px, found.boards[0].points_mm), test)
        about = f"{found.camera.model}{pupil_words(found)}; {seen(count, total)}"
        yield bench.row(quantity, RIGKIT, rms, variant=f"board {found.boards[0].kind}", how=about)
    for peer, fit in peers.CAMERA_FITS.items():
        if peer.variant:
            continue
        try:
            found_peer = fit(train, size_px, True)
            rms, count = rms_of(found_peer, test)
        except PEER_FAILURES as error:
            yield bench.row(quantity, peer.tool, None, how=str(error).splitlines()[-1])
            continue
        yield bench.row(quantity, peer.tool, rms, how=seen(count, total))
    held = range(len(train), len(train) + len(test))
    yield from mrcal_rows(bench, quantity, [*train, *test], size_px, True, [held])


def tracked_poses(path: Path, work: Path, views: Views) -> dict[str, Rigid3]:
    """Return the poses of a file of motion capture at the moments of the images, mm."""
    named = work / f"{path.parent.name}-{path.name}"
    rows = path.read_text().splitlines()[1:]
    named.write_text("\n".join(["timestamp_ns,x_m,y_m,z_m,qx,qy,qz,qw", *rows]) + "\n")
    return read_robot_poses(named, [view.image for view in views])


def aprilgrid_mocap(bench: Bench) -> Iterator[Row]:
    """Yield the board's poses against motion capture, after one hand-eye fit for each tool's camera."""
    found = bench.alone("cam0/data/*.jpg").calibration
    views, size_px = kept_views(found, bench.found.described.boards), found.camera.size_px
    files = (bench.found.files(name)[0] for name in ("body0.csv", "target0/data.csv"))
    body, target = (tracked_poses(path, bench.work, views) for path in files)
    stands = [body[view.image].inverse() @ target[view.image] for view in views]
    fits = {(RIGKIT, f"board {found.boards[0].kind}"): found.camera}
    for peer, fit in peers.CAMERA_FITS.items():
        if not peer.variant:
            fits[peer.tool, ""] = fit(views, size_px, False).camera
    for (tool, variant), camera in fits.items():
        yield from _pose_rows(bench, tool, variant, camera, views, stands)
    yield from compared(bench, found, False)


def _pose_rows(
    bench: Bench, tool: str, variant: str, camera: Camera, views: Views, stands: Sequence[Rigid3]
) -> Iterator[Row]:
    fitted = hand_eye(camera, views, stands)
    how = f"median of {len(fitted.image_rms_px)} images after one hand-eye fit"
    off_mm = float(np.median(fitted.translation_residuals_mm))
    turned = float(np.degrees(np.median(fitted.rotation_residuals_rad)))
    yield bench.row("board against motion capture", tool, off_mm, "mm", variant=variant, how=how)
    yield bench.row("board's turn, likewise", tool, turned, "deg", variant=variant, how=how)
