"""What the camera formats of other programs have in common: the camera as written, and what was lost on the way."""

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

MM_PER_M = 1000.0
MIN_REPORTED_PX = 0.1
"""Where a refit is off by more, what would lose nothing is said."""


@dataclass(frozen=True, eq=False, slots=True)
class Accepted:
    """A model that a format can hold: of Brown's model `order` terms."""

    model: str
    order: int | None = None

    def holds(self, camera: Camera) -> bool:
        """Say whether the camera goes in as it is."""
        of_order = self.order is None or camera.model != "brown" or camera.parameters.size - 4 == self.order
        return camera.model == self.model and of_order


PERSPECTIVE = (Accepted("pinhole"), Accepted("brown", 4), Accepted("brown", 5), Accepted("brown", 8))
"""Models of OpenCV's calib3d, which most formats can hold."""


@dataclass(frozen=True, eq=False, slots=True)
class Written:
    """A camera in another program's format.

    Attributes
    ----------
    camera : the camera as the file describes it.
    max_error_px : its projection against the camera given, over the part of the image it covers, inside the outline of
        what was seen where that is known; 0 where the format has the model.
    covered : that part, as a share of the image.
    note : in words, what a user of the file should know; empty where nothing was lost.
    text : the file; empty until it is written.
    """

    camera: Camera
    max_error_px: float = 0.0
    covered: float = 1.0
    note: str = ""
    text: str = ""


def best_accepted(
    camera: Camera, accepted: Sequence[Accepted], format_name: str, outline: Pixels | None = None
) -> Written:
    """Return the camera itself where the format has its model, else the nearest of those that it has.

    Nearest: the one that covers most of the image, then the one with the smallest largest error inside the `outline`
    (N, 2) of what was seen, convex; None: over all of it. Outside, where the camera given is but extrapolated, errors
    count by OUTSIDE_WEIGHT.
    Raises InputError where none can follow the lens.
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
        note = f"{format_name} has no {lacks}: refitted as {kind.model}, off by {digits(c.max_px)} px at most"
        if outline is not None:
            note += f" where boards were and {digits(c.outside_px)} px elsewhere"
        if c.covered < 1.0:
            reach = min(np.degrees(c.reach_rad), np.degrees(c.camera.max_angle_rad))
            note += f" within {reach:.0f} degrees of the axis ({100.0 * c.covered:.0f} % of the image); wrong beyond"
        if c.max_px > MIN_REPORTED_PX:
            degree = "" if kind.model != camera.model else f" and degree = {kind.order}"
            note += f'; with model = "{kind.model}"{degree} in the session nothing is lost'
        cost = max(c.max_px, OUTSIDE_WEIGHT * c.outside_px)
        found.append((cost, Written(c.camera, c.max_px, c.covered, note)))
    if not found:
        raise InputError(
            f"{format_name}: none of its models can follow this {camera.model} camera; choose another format"
        )
    widest = max(c.covered for _, c in found)
    return min((entry for entry in found if entry[1].covered >= widest - 0.01), key=lambda entry: entry[0])[1]


def _without_zero_terms(camera: Camera) -> list[Camera]:
    """Return the same Brown camera with fewer terms, as far as those left out are zero."""
    if camera.model != "brown":
        return []
    p = camera.parameters
    counts = [4 + count for count in sorted(type(camera).orders, reverse=True) if 4 + count < p.size]
    return [camera.with_parameters(p[:n]) for n in counts if not p[n:].any()]


def field(data: dict[str, Any], key: str, name: str) -> Any:
    """Return data[key]; raises InputError that names file and key."""
    if not isinstance(data, dict) or key not in data:
        raise InputError(f"'{name}': '{key}' is missing; is it the calibration file of another program?")
    return data[key]


def numbers(value: Any, name: str, key: str, count: int | None = None) -> FloatArray:
    """Return `value` as finite numbers (N,); raises InputError that names file and key."""
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


def image_size(value: Any, name: str, key: str) -> tuple[int, int]:
    """Return (width, height); raises InputError that names file and key for what is no pair of whole numbers."""
    width, height = numbers(value, name, key, 2).tolist()
    for side in (width, height):
        if side != np.floor(side) or not 1.0 <= side <= MAX_SIDE_PX:
            raise InputError(f"'{name}': '{key}' has {side:g}, which is no number of pixels; correct it")
    return int(width), int(height)


def written_size(data: dict[str, Any], name: str) -> tuple[int, int]:
    """Return (width, height) under the keys of OpenCV and ROS; raises InputError as `field` and `image_size` do."""
    keys = ("image_width", "image_height")
    return image_size([field(data, key, name) for key in keys], name, ", ".join(keys))


def camera_of(model: str, size_px: tuple[int, int], parameters: FloatArray, name: str) -> Camera:
    """Return the camera; raises InputError that names the file where the values make none."""
    try:
        camera = camera_model(model)(size_px, parameters)
    except InputError as error:
        raise InputError(f"'{name}': {error}; is it the calibration of this format?") from error
    if (fault := fault_of_lens(camera)) is not None:
        raise InputError(f"'{name}': {fault}; is it the calibration of this format?")
    return camera


def unified_with_xi(camera: Camera) -> tuple[float, FloatArray]:
    """Return xi and gamma_x, gamma_y, cx, cy of a unified camera as Mei writes it: gamma = f (1 + xi).

    Raises InputError at alpha = 1, where xi is infinite.
    """
    *core, alpha = camera.parameters.tolist()
    if alpha >= 1.0:
        raise InputError("ucm camera: alpha = 1 has no xi; export it as another model")
    xi = alpha / (1.0 - alpha)
    return xi, np.array([core[0] * (1.0 + xi), core[1] * (1.0 + xi), core[2], core[3]])


def unified_from_xi(size_px: tuple[int, int], xi: float, core: FloatArray, name: str) -> Camera:
    """Return the unified camera of xi and gamma_x, gamma_y, cx, cy; the reverse of `unified_with_xi`.

    Raises InputError that names the file for a negative xi: its sphere would be seen from behind.
    """
    if not xi >= 0.0:
        raise InputError(f"'{name}': xi = {xi:g}, which is never negative; calibrate again")
    return camera_of("ucm", size_px, np.array([*(core[:2] / (1.0 + xi)), *core[2:], xi / (1.0 + xi)]), name)
