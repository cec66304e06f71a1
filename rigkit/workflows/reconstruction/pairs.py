"""One pair of a data set: detection, matching and reconstruction of its boards as declared in the manifest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rigkit.calibration.board_shape import BoardShape, declared_alike, measured_shape
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import far_camera
from rigkit.core.choices import Planes, Support
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError, RigkitError
from rigkit.detection.detect import detect_boards
from rigkit.identification.wrong_squares import fitting_squares
from rigkit.io.manifests.manifest import Pair
from rigkit.io.media.images import read_image_of, to_grey
from rigkit.reconstruction.board_planes import BoardPlanes
from rigkit.reconstruction.calibration_shifts import CalibrationShifts, calibration_shifts, with_calibrations
from rigkit.reconstruction.geometry import PairGeometry, pair_geometry
from rigkit.reconstruction.pairing import MatchedPair, match_pair
from rigkit.reconstruction.reconstruct import Reconstruction, fit_planes, on_planes, reconstruct_from
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.validation.board_ends import contradicted_counts
from rigkit.validation.diagnose import diagnose_squares
from rigkit.workflows.reconstruction.datasets import LoadedCamera

Detections: TypeAlias = tuple[BoardDetection, ...]
Image: TypeAlias = NDArray[Any]


@dataclass(frozen=True, eq=False, slots=True)
class BoardsOfPair:
    """The boards that were found in the two images of a pair; `cameras`, `boards` and `images` are of either image."""

    pair: Pair
    cameras: tuple[Camera, Camera]
    boards: tuple[Detections, Detections]
    images: tuple[Image, Image]

    def matched(self, chain: str, support: Support = "patch") -> MatchedPair:
        """Return the matched corners of the boards, as declared in the manifest; cameras as for `match_pair`."""
        return match_pair(
            self.pair.pair_id,
            *self.cameras,
            *self.boards,
            self.pair.boards,
            layout=self.pair.layout or None,
            angles=self.pair.truth.angles,
            chain="rectified" if chain == "rectified" else "raw",
            support=support,
        )

    def squares_that_fit(self) -> tuple[str, ...]:
        """Return, in words, the square size with which a misfitting board would fit the other boards of the pair."""
        far1, far2 = (far_camera(camera) for camera in self.cameras)
        return diagnose_squares(fitting_squares(*self.boards, self.pair.boards, far1, far2))


def find_boards(pair: Pair, camera1: Camera, camera2: Camera) -> BoardsOfPair:
    """Return the boards found in each image of a pair; raises InputError if an image shows none.

    The cameras are used to predict missed corners, join parts of boards, reject occluded corners and model distortion.
    """
    images = []
    found: list[Detections] = []
    for path, camera, entry in ((pair.image1, camera1, pair.camera1), (pair.image2, camera2, pair.camera2)):
        image = read_image_of(path, camera.size_px, entry.calibration)
        detections = detect_boards(to_grey(image), pair.boards, camera=far_camera(camera))
        if not detections:
            sizes = ", ".join(sorted({f"{b.columns}x{b.rows}" for b in pair.boards}))
            raise InputError(
                f"pair '{pair.pair_id}': no board ({sizes}) found in '{path}'; check the image and the boards"
            )
        images.append(image)
        found.append(detections)
    return BoardsOfPair(pair, (camera1, camera2), (found[0], found[1]), (images[0], images[1]))


def match_images(
    pair: Pair, camera1: Camera, camera2: Camera, chain: str, support: Support = "patch"
) -> tuple[MatchedPair, Image, Image]:
    """Return the matched corners of a pair, and its two images.

    For a board that does not fit as declared, the square size that would fit is stated in the notes, or in the error
    raised if no board is left. Raises InputError if the images contradict a declared number of columns or rows.
    """
    found = find_boards(pair, camera1, camera2)
    try:
        matched = found.matched(chain, support)
    except RigkitError as error:
        message = found.squares_that_fit()
        if not message:
            raise
        raise type(error)(f"pair '{pair.pair_id}': {'; '.join(message)} ({error})") from error
    if matched.identity.missing:
        matched = replace(matched, notes=(*found.squares_that_fit(), *matched.notes))
    for check in contradicted_counts(matched, [to_grey(image) for image in found.images]):
        raise InputError(f"pair '{pair.pair_id}': {check.name}: {check.measured:g} {check.how}")
    return matched, *found.images


def geometry_of(matched: MatchedPair, pair: Pair) -> PairGeometry:
    """Return the pose and points of matched corners, with pose type and level as declared in the manifest."""
    level = None if pair.level_sigma_deg is None else float(np.deg2rad(pair.level_sigma_deg))
    frames = None if pair.down is None else LevelFrames.from_down(*pair.down)
    return pair_geometry(matched, pose_type=pair.pose_type, level_sigma_rad=level, level_frames=frames)


def reconstruct_with(
    matched: MatchedPair, pair: Pair, method: str, image1: Image | None = None, *, det_scale: str = "area"
) -> Reconstruction:
    """Reconstruct matched corners, as declared in the manifest."""
    return reconstruct_from(geometry_of(matched, pair), affine_method=method, scale=det_scale, image1=image1)


def shifts_of(reconstruction: Reconstruction, camera1: LoadedCamera, camera2: LoadedCamera) -> CalibrationShifts | None:
    """Return the effect of the calibrations' covariances on a reconstruction; None if a camera has no covariance."""
    known1, known2 = camera1.known, camera2.known
    if known1 is None or known2 is None:
        return None
    second = None if camera1 is camera2 else known2
    return calibration_shifts(reconstruction, known1, second)


def measured_shapes(pair: Pair, camera1: LoadedCamera, camera2: LoadedCamera) -> dict[str, BoardShape]:
    """Return the boards of a pair, by id, whose corners the calibration of camera 1, or else of camera 2, measured.

    Of boards declared alike, which one was measured is unknown: none is returned.
    """
    out: dict[str, BoardShape] = {}
    for board in pair.boards:
        if sum(declared_alike(other, board) for other in pair.boards) == 1:
            known = (one.calibration.boards for one in (camera1, camera2) if one.calibration is not None)
            found = [shape for shapes in known if (shape := measured_shape(shapes, board)) is not None]
            out |= {board.board_id: found[0]} if found else {}
    return out


def planes_of(geometry: PairGeometry, planes: Planes, camera1: LoadedCamera, camera2: LoadedCamera) -> BoardPlanes:
    """Return the boards' planes fitted to both images; their sigmas include those of the calibrations.

    Raises DegenerateError for too few corners.
    """
    return fit_planes(geometry, planes, camera1.known, camera2.known, one_camera=camera1 is camera2)


def with_calibration_sigmas(
    reconstruction: Reconstruction, planes: Planes, camera1: LoadedCamera, camera2: LoadedCamera
) -> Reconstruction:
    """Return a reconstruction moved onto `planes`, with the calibrations' covariances in its sigmas.

    Raises DegenerateError for too few corners to fit planes.
    """
    if planes == "free":
        return with_calibrations(reconstruction, shifts_of(reconstruction, camera1, camera2))
    if reconstruction.geometry is None:
        raise InputError(f"pair '{reconstruction.pair_id}': planes are fitted to boards, and there are none")
    return on_planes(reconstruction, planes_of(reconstruction.geometry, planes, camera1, camera2))


def reconstruct_other_chain(matched: MatchedPair, pair: Pair) -> Reconstruction | None:
    """Reconstruct the same corners in the other chain (raw or rectified); None if that is degenerate."""
    try:
        return reconstruct_with(matched.in_chain("rectified" if matched.chain == "raw" else "raw"), pair, "3SDIR")
    except DegenerateError:
        return None
