"""Common parts of the camera formats: the best model that a format accepts, and readers of fields and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigkit.cameras.base import MAX_SIDE_PX, Camera
from rigkit.cameras.convert import OUTSIDE_WEIGHT, convert_camera
from rigkit.cameras.plausible import fault_of_lens
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import FloatArray, Pixels
from rigkit.core.errors import InputError
from rigkit.core.printing import digits
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.nearest import EXACT_PX

MM_PER_M = 1000.0
MIN_REPORTED_PX = 0.1
"""For refits with larger errors, the note names a model of the session without loss."""


@dataclass(frozen=True, eq=False, slots=True)
class Accepted:
    """A model that a format accepts; `order` is the number of terms of Brown's model, or a polynomial's degree."""

    model: str
    order: int | None = None

    def holds(self, camera: Camera) -> bool:
        """Return whether the format accepts the camera without a refit."""
        of_order = self.order is None or camera.model != "brown" or camera.parameters.size - 4 == self.order
        return camera.model == self.model and of_order


PERSPECTIVE = (Accepted("pinhole"), Accepted("brown", 4), Accepted("brown", 5), Accepted("brown", 8))
"""Models of OpenCV's calib3d, which most formats accept."""


@dataclass(frozen=True, eq=False, slots=True)
class Written:
    """A camera in another program's format.

    Attributes
    ----------
    camera : the camera in the file.
    max_error_px : largest difference of projections from the original camera, over the covered part of the image and
        inside the outline of the corners, if known; 0 if the format has the model.
    covered : fraction of the image that the camera covers.
    note : note for users of the file; empty if nothing was lost.
    text : content of the file; empty until it is written.
    """

    camera: Camera
    max_error_px: float = 0.0
    covered: float = 1.0
    note: str = ""
    text: str = ""


def best_accepted(
    camera: Camera, accepted: Sequence[Accepted], format_name: str, outline: Pixels | None = None
) -> Written:
    """Return the camera itself if the format accepts its model, else the best refit by an accepted model.

    The best refit covers most of the image, then has the smallest maximum error inside the convex `outline` (N, 2) of
    the corners; None: in the whole image. Outside of it, where the original camera is extrapolated, errors are weighted
    by OUTSIDE_WEIGHT. Raises InputError if no model fits.
    """
    for same in (camera, *_without_zero_terms(camera)):
        for kind in accepted:
            if kind.holds(same):
                return Written(same)
    found: list[tuple[float, Written]] = []
    for kind in accepted:
        try:
            c = convert_camera(camera, kind.model, order=kind.order, outline=outline)
        except InputError:
            continue
        fewer = any(k.model == camera.model for k in accepted)
        lacks = f"{camera.model} model" + (" with these terms" if fewer else "")
        note = f"{format_name} has no {lacks}: refitted as {kind.model}, "
        exact = max(c.max_px, c.outside_px) <= EXACT_PX
        note += f"within {EXACT_PX:g} px" if exact else f"off by {digits(c.max_px)} px at most"
        if outline is not None and not exact:
            note += f" where boards were and {digits(c.outside_px)} px elsewhere"
        if c.covered < 1.0:
            reach = min(np.degrees(c.reach_rad), np.degrees(c.camera.max_angle_rad))
            note += f" within {reach:.0f} degrees of the axis ({100.0 * c.covered:.0f} % of the image); wrong beyond"
        if c.max_px > MIN_REPORTED_PX:
            of_order = f'model = "{kind.model}" and degree = {kind.order} in the session'
            setting = f"--model {kind.model}" if kind.order is None else of_order
            note += f"; with {setting} nothing is lost when calibrating"
        cost = max(c.max_px, OUTSIDE_WEIGHT * c.outside_px)
        found.append((cost, Written(c.camera, c.max_px, c.covered, note)))
    if not found:
        raise InputError(
            f"{format_name}: none of its models can follow this {camera.model} camera; choose another format"
        )
    widest = max(c.covered for _, c in found)
    return min((entry for entry in found if entry[1].covered >= widest - 0.01), key=lambda entry: entry[0])[1]


def _without_zero_terms(camera: Camera) -> list[Camera]:
    """Return the Brown camera with fewer terms, for all counts whose omitted terms are zero."""
    if camera.model != "brown":
        return []
    p = camera.parameters
    counts = [4 + count for count in sorted(type(camera).orders, reverse=True) if 4 + count < p.size]
    return [camera.with_parameters(p[:n]) for n in counts if not p[n:].any()]


def field(data: dict[str, Any], key: str, name: str) -> Any:
    """Return data[key]; raises InputError with the file and the key."""
    if not isinstance(data, dict) or key not in data:
        raise InputError(f"'{name}': '{key}' is missing; is it the calibration file of another program?")
    return data[key]


def numbers(value: Any, name: str, key: str, count: int | None = None) -> FloatArray:
    """Return `value` as finite numbers (N,); raises InputError with the file and the key."""
    try:
        raw = np.asarray(value)
        words = isinstance(value, list) and any(isinstance(one, bool) for one in value)
        if words or (raw.size and raw.dtype.kind not in "iuf"):
            raise TypeError
        array = raw.astype(np.float64).reshape(-1)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"'{name}': '{key}' is not a list of numbers; is the file whole?") from error
    if not np.isfinite(array).all() or (count is not None and array.size != count):
        wanted = "finite numbers" if count is None else f"{count} finite numbers"
        raise InputError(f"'{name}': '{key}' should have {wanted}, has {array.size}; is the file whole?")
    return array


def numbers_of_words(words: Sequence[str], name: str, key: str, count: int | None = None) -> FloatArray:
    """Return words as finite numbers (N,); raises InputError with the file and the key."""
    try:
        return numbers([float(word) for word in words], name, key, count)
    except ValueError as error:
        raise InputError(f"'{name}': '{key}' is not a list of numbers; is the file whole?") from error


def image_size(value: Any, name: str, key: str) -> tuple[int, int]:
    """Return (width, height); raises InputError with the file and the key for anything but a pair of integers."""
    width, height = numbers(value, name, key, 2).tolist()
    for side in (width, height):
        if side != np.floor(side) or not 1.0 <= side <= MAX_SIDE_PX:
            raise InputError(f"'{name}': '{key}' has {side:g}, which is no number of pixels; correct it")
    return int(width), int(height)


def written_size(data: dict[str, Any], name: str) -> tuple[int, int]:
    """Return (width, height) by the keys of OpenCV and ROS; raises InputError as `field` and `image_size`."""
    keys = ("image_width", "image_height")
    return image_size([field(data, key, name) for key in keys], name, ", ".join(keys))


def camera_of(model: str, size_px: tuple[int, int], parameters: FloatArray, name: str) -> Camera:
    """Return the camera; raises InputError with the file for invalid or implausible parameters."""
    try:
        camera = camera_model(model)(size_px, parameters)
    except InputError as error:
        raise InputError(f"'{name}': {error}; is it the calibration of this format?") from error
    if (fault := fault_of_lens(camera)) is not None:
        raise InputError(f"'{name}': {fault}; is it the calibration of this format?")
    return camera


def pose_of(rotation: FloatArray, translation_mm: FloatArray, name: str) -> Rigid3:
    """Return the pose of R (3, 3) and t (3,); raises InputError with the file for a matrix that is no rotation."""
    try:
        return Rigid3(rotation, translation_mm)
    except InputError as error:
        raise InputError(f"'{name}': {error}; is the file whole?") from error


def unified_with_xi(camera: Camera) -> tuple[float, FloatArray]:
    """Return xi and gamma_x, gamma_y, cx, cy of a unified camera in Mei's notation: gamma = f (1 + xi).

    Raises InputError at alpha = 1, where xi is infinite.
    """
    *core, alpha = camera.parameters.tolist()
    if alpha >= 1.0:
        raise InputError("ucm camera: alpha = 1 has no xi; export it as another model")
    xi = alpha / (1.0 - alpha)
    return xi, np.array([core[0] * (1.0 + xi), core[1] * (1.0 + xi), core[2], core[3]])


def unified_from_xi(size_px: tuple[int, int], xi: float, core: FloatArray, name: str) -> Camera:
    """Return the unified camera of xi and gamma_x, gamma_y, cx, cy; the reverse of `unified_with_xi`.

    Raises InputError with the file for a negative xi.
    """
    if not xi >= 0.0:
        raise InputError(f"'{name}': xi = {xi:g}, which is never negative; calibrate again")
    return camera_of("ucm", size_px, np.array([*(core[:2] / (1.0 + xi)), *core[2:], xi / (1.0 + xi)]), name)
