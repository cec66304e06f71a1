"""`rigkit pose` and `rigkit handeye`: the pose of a camera relative to a board, and on a robot."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rigkit.calibration.board_shape import BoardShape, measured_shape
from rigkit.calibration.hand_eye import HandEye, hand_eye
from rigkit.calibration.solving.shape import WARP_UNKNOWNS, warp_of_board
from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import board_with_fixed_pupil, pose_covariance_of_lens
from rigkit.cameras.moving_pupil import NearCamera, far_camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, BoardView
from rigkit.core.errors import CheckFailed, DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.detection.larger_grid import larger_grid
from rigkit.geometry.board_pose import BoardPose, board_poses
from rigkit.io.boards.board_words import board_of_words
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.io.disk.json_reader import json_text
from rigkit.io.disk.reading import about, paths_of
from rigkit.io.disk.writing import ensure_writable, write_atomic
from rigkit.io.manifests.robot_poses import read_robot_poses
from rigkit.io.media.images import read_image, read_image_of
from rigkit.validation.monitoring.evidence import Monitored
from rigkit.validation.monitoring.watch import monitored_camera
from rigkit.workflows.detect import images_in
from rigkit.workflows.inputs.camera_files import import_near_camera
from rigkit.workflows.inputs.identify_board import why_not_detected
from rigkit.workflows.options.cameras import HandEyeOptions

_log = logging.getLogger(__name__)

HAND_EYE_SCHEMA = "rigkit.hand_eye/1"
POSE_NAMES = (("cam_from_hand", "base_from_board"), ("cam_from_base", "hand_from_board"))
"""Names of the two poses if the hand carries the camera, and if it carries the board."""
PLANAR_AMBIGUITY = 1.5
"""Two poses of one board whose errors differ by less than this factor are ambiguous."""


@dataclass(frozen=True, eq=False, slots=True)
class HandEyeCalibration:
    """The hand-eye calibration, and the errors of images that cannot be read."""

    result: HandEye
    unreadable: tuple[InputError, ...]

    __repr__ = brief


@dataclass(frozen=True, eq=False, slots=True)
class PlacedCamera:
    """The pose of a camera relative to a board.

    Attributes
    ----------
    pose : with its covariance, from the noise of the corners, the sigma of the squares if the board's file states one,
        and the covariance of the lens if `lens_known`, with that of the board's corners if `board_measured`.
    image : the image that shows the board.
    rms_px : reprojection error of the corners, rms.
    ambiguous : whether a second pose, with the board tilted the other way, fits almost as well.
    lens_known : whether the calibration has a covariance.
    board_measured : whether the corners of the board are those that the calibration measured, not those declared.
    """

    pose: BoardPose
    image: Path
    rms_px: float
    ambiguous: bool
    lens_known: bool
    board_measured: bool

    __repr__ = brief


def calibrate_hand_eye(
    poses: str | Path,
    images: str | Path | Sequence[str | Path],
    options: HandEyeOptions,
    *,
    progress: Progress = silent,
) -> HandEyeCalibration:
    """Return the hand-eye calibration from the robot's poses (CSV, by image) and images of a board, or folders of them.

    Images that cannot be read go into `unreadable`.

    Raises InputError: files that cannot be read or written, images without a pose, a board that is symmetric under a
    half turn, poses that contradict the images; CheckFailed: no image shows the board; DegenerateError: too few images,
    or rotations about one axis only.
    """
    paths = list(images_in(paths_of(images)))
    ensure_writable(options.output, force=options.force, inputs=[poses, *paths, options.camera, options.board])
    robot = read_robot_poses(poses, [path.name for path in paths])
    missing = [path.name for path in paths if path.name not in robot]
    if missing:
        raise InputError(f"'{poses}': no pose of image '{missing[0]}' ({len(missing)} in all); add the rows")
    board = board_of_words(str(options.board))
    if board.looks_same_turned:
        raise InputError(
            f"board '{board.board_id}' looks the same turned by 180 degrees: take {board.pattern.unambiguous}, or one "
            "with markers"
        )
    camera, shape = import_near_camera(options.camera), _measured_shape(options.camera, board)
    views, stands, unreadable = [], [], []
    for done, path in enumerate(paths, start=1):
        try:
            seen = _boards_in(path, board, far_camera(camera), options.camera)
            view = _view_of(path, seen, board, shape, camera)
        except InputError as error:
            if len(paths) == 1:
                raise
            unreadable.append(error)
            continue
        finally:
            progress("board", done, len(paths))
        if view is not None:
            base_from_hand = robot[path.name].inverse() if options.inverse else robot[path.name]
            views.append(view)
            stands.append(base_from_hand if options.board_on_hand else base_from_hand.inverse())
    if not views:
        if unreadable:
            raise InputError(f"no image of {len(paths)} shows board '{board.board_id}': {unreadable[0]}")
        raise CheckFailed(f"no image of {len(paths)} shows board '{board.board_id}'; check the board's file")
    with about(poses):
        result = hand_eye(far_camera(camera), views, stands, board_on_hand=options.board_on_hand)
    if options.output is not None:
        write_atomic(options.output, hand_eye_text(result, options), force=options.force)
    return HandEyeCalibration(result, tuple(unreadable))


def camera_on_board(image: str | Path, camera: str | Path, board: str | Path) -> PlacedCamera:
    """Return the pose of a camera relative to a board, from one image.

    Raises InputError for files that cannot be read, CheckFailed if the image does not show the board.
    """
    known, near = board_of_words(str(board)), import_near_camera(camera)
    lens = far_camera(near)
    seen = _boards_in(Path(image), known, lens, camera)
    shape = _measured_shape(camera, known)
    view = _view_of(Path(image), seen, known, shape, near)
    if view is None:
        alike = sum(frozenset((d.columns, d.rows)) == frozenset(known.size) for d in seen)
        if alike > 1:
            raise CheckFailed(
                f"'{image}' shows {alike} grids of the size of board '{known.board_id}', and which one is the "
                "board is unknown; cover the other pattern"
            )
        why = why_not_detected([Path(image)], [known]) or "check focus and the board's file"
        raise CheckFailed(f"'{image}' does not show board '{known.board_id}'; {why}")
    larger = larger_grid(read_image(image), seen, [known])
    if larger is not None:
        _log.warning(f"check columns and rows: in '{image}' {larger}")
    with about(camera, image):
        found, valid = _poses(lens, view)
        points = view.points()[valid]
        projected, _ = lens.project(found[0].cam_from_board.apply(points))
        rms = float(np.sqrt(((projected - view.pixels[valid]) ** 2).sum(axis=1).mean()))
        if not np.isfinite(found[0].covariance).all() or not np.isfinite(rms):
            raise DegenerateError("the board is outside the camera's field of view; check the camera file")
    ambiguous = len(found) > 1 and found[1].rms_rad < PLANAR_AMBIGUITY * found[0].rms_rad
    pose, covariance, calibrated = found[0].cam_from_board, found[0].covariance.copy(), _calibrated(camera)
    if calibrated is not None:
        by_board = pose.rotation @ _by_warps(calibrated, shape, view.grid[valid])
        near, given = calibrated.cameras[0], calibrated.covariance
        covariance += pose_covariance_of_lens(
            near, given, pose.apply(points), pose.translation_mm, view.sigma_px[valid], by_board
        )
    if known.square_sigma_mm is not None:
        shift = pose.translation_mm * known.square_sigma_mm / np.sqrt(known.square_x_mm * known.square_y_mm)
        covariance[3:, 3:] += np.outer(shift, shift)
    placed = BoardPose(pose, found[0].rms_rad, covariance)
    return PlacedCamera(placed, Path(image), rms, ambiguous, calibrated is not None, shape is not None)


def _with_fixed_pupil(camera: Camera, view: BoardView) -> BoardView:
    """Return the view with its pixels moved to where a camera with a fixed entrance pupil sees the points."""
    if not isinstance(camera, NearCamera):
        return view
    return replace(view, pixels=board_with_fixed_pupil(camera, view.pixels, view.points()))


def _calibrated(camera: str | Path) -> Monitored | None:
    """Return the camera and the warps of its measured boards, with the covariance of its file; None for another tool's
    file, which has none."""
    try:
        return monitored_camera(load_calibration(camera), "camera", quoted=True)
    except InputError:
        return None


def _by_warps(calibrated: Monitored, shape: BoardShape | None, grid: IntArray) -> FloatArray:
    """Return the derivatives (N, 3, B) of a board's corners at `grid` (N, 2), in its frame, by the warps of all boards
    that were measured; `shape` is that board's, None for one that is as declared."""
    out = np.zeros((len(grid), 3, WARP_UNKNOWNS * len(calibrated.warped)))
    if shape is not None:
        first = WARP_UNKNOWNS * calibrated.warped.index(shape.board_id)
        basis = warp_of_board(shape.points_mm).basis
        out[..., first : first + WARP_UNKNOWNS] = basis[grid @ np.array([1, shape.column_count])]
    return out


def _boards_in(path: Path, board: Board, camera: Camera, calibration: str | Path) -> Sequence[BoardDetection]:
    return detect_boards(read_image_of(path, camera.size_px, calibration), [board], camera=camera)


def _view_of(
    path: Path, seen: Sequence[BoardDetection], board: Board, shape: BoardShape | None, camera: Camera
) -> BoardView | None:
    """Return the largest view of the board, as seen with a fixed pupil; its corners are those of `shape` if known.

    A measured board is not as symmetric as a declared one: of its orientations the one that fits best is returned.
    """
    found = [d for d in seen if d.board_id == board.board_id]
    if not found:
        return None
    largest = max(found, key=lambda d: len(d.grid))
    view = BoardView.from_detection(path.name, largest, [board])
    if shape is None:
        return _with_fixed_pupil(camera, view)
    turned = [largest.turned(turns) for turns in (0, *board.turns)]
    views = [
        replace(view, grid=d.grid, pixels=d.pixels, sigma_px=d.sigma_px, points_mm=shape.at(d.grid)) for d in turned
    ]
    with about(path):
        views = [_with_fixed_pupil(camera, one) for one in views]
        return min(views, key=lambda one: _poses(far_camera(camera), one)[0][0].rms_rad) if board.turns else views[0]


def _poses(lens: Camera, view: BoardView) -> tuple[tuple[BoardPose, ...], BoolArray]:
    """Return the poses of a board, best first, and which corners (N,) bool are in the field of view."""
    rays, valid = lens.unproject(view.pixels)
    unit = np.linalg.norm(lens.ray_jacobian(view.pixels[valid]), axis=(1, 2)) / np.sqrt(2.0)
    return board_poses(rays[valid], view.points()[valid], view.sigma_px[valid] * unit), valid


def _measured_shape(camera: str | Path, board: Board) -> BoardShape | None:
    """Return the shape that a calibration file measured of this board, whatever its name there; None if it has none."""
    try:
        shapes = load_calibration(camera).boards
    except InputError:
        return None
    shape = measured_shape(shapes, board)
    if shape is None and measured_shape(shapes, board, across=True) is not None:
        columns, rows = board.size[::-1]
        _log.warning(
            "'%s' measured the corners of a board of %dx%d, taken here as flat: declare it that way round to use them",
            camera,
            columns,
            rows,
        )
    return shape


def hand_eye_text(result: HandEye, options: HandEyeOptions) -> str:
    """Return the content of the result's file."""
    first, second = POSE_NAMES[options.board_on_hand]
    data = {
        "schema": HAND_EYE_SCHEMA,
        first: result.cam_from_mount.matrix()[:3].tolist(),
        second: result.stand_from_board.matrix()[:3].tolist(),
        "covariance": result.covariance.tolist(),
        "freedom": result.freedom,
        "robot_sigma_deg": float(np.degrees(result.robot_turn_rad)),
        "robot_sigma_mm": result.robot_move_mm,
        "rms_px": result.rms_px,
        "image_rms_px": result.image_rms_px,
        "median_apart_mm": float(np.median(result.translation_residuals_mm)),
        "median_apart_deg": float(np.degrees(np.median(result.rotation_residuals_rad))),
        "left_out_deg": {name: float(np.degrees(value)) for name, value in result.left_out.items()},
        "contradicting": {
            name: {"deg": float(np.degrees(turn)), "mm": move} for name, (turn, move) in result.contradicting.items()
        },
    }
    return json_text(data)
