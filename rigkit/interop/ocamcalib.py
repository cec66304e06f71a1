"""OCamCalib's calib_results.txt (also written by ImprovedOcamCalib), and the JSON of py-OCamCalib.

OCamCalib's pixels are (row, column) from 0; its frame is x down, y right, z backwards, so that the polynomial is
negative on the axis: its (x, y, z) is (y, x, -z) in rigkit. Its affine matrix [[c, d], [e, 1]] maps (down, right) to
(row, column) and has a redundant degree of freedom, a rotation about the axis: rigkit's has e = 0.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import cast

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.scaramuzza import DEGREES, Scaramuzza
from rigkit.core.arrays import FloatArray, Mat3, Pixels
from rigkit.core.errors import InputError
from rigkit.interop.exchange import (
    Accepted,
    Written,
    best_accepted,
    camera_of,
    image_size,
    numbers,
    numbers_of_words,
)

ENOUGH_PX = 0.02
"""A polynomial of a higher degree is only used if the lower one has a larger error."""
INVERSE_ENOUGH_PX = 1e-3
INVERSE_DEGREES = range(4, 23, 2)
"""Degrees of the inverse polynomial, increased until it fits, as in OCamCalib."""
TITLES = (
    "#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). These are used by cam2world",
    "#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). "
    "These are used by world2cam",
    '#center: "row" and "column", starting from 0 (C convention)',
    '#affine parameters "c", "d", "e"',
    '#image size: "height" and "width"',
)


def write_ocamcalib(camera: Camera, outline: Pixels | None = None) -> Written:
    """Return the camera as calib_results.txt; `outline` is as for `best_accepted`.

    The note states the error of the inverse polynomial, which only OCamCalib's world2cam uses.
    """
    chosen = _scaramuzza(camera, outline)
    c = chosen.camera
    polynomial = np.insert(c.parameters[:-4], 1, 0.0)
    cx, cy, stretch, shear = c.parameters[-4:]
    # (row, column) = [[1/c, 0], [d/c, 1]] (down, right), with lengths scaled by c.
    ss = -polynomial * stretch ** (1.0 - np.arange(polynomial.size))
    inverse, error_px = _inverse_polynomial(ss, c, stretch)
    values = (
        [ss.size, *ss],
        [inverse.size, *inverse],
        [cy, cx],
        [1.0 / stretch, 0.0, shear / stretch],
        [c.size_px[1], c.size_px[0]],
    )
    text = "".join(
        f"{title}\n\n{' '.join(str(v) if isinstance(v, int) else repr(float(v)) for v in row)}\n\n"
        for title, row in zip(TITLES, values, strict=True)
    )
    note = f"the inverse polynomial of {inverse.size} terms follows to {error_px:.2g} px"
    return replace(chosen, text=text, note=f"{chosen.note}; {note}" if chosen.note else note)


def read_ocamcalib(text: str, name: str = "calib_results.txt") -> tuple[Scaramuzza, Mat3]:
    """Return the camera, and the rotation cam_from_ocam that converts poses of the file.

    Raises InputError for a damaged file, or a polynomial of the wrong sign or with a linear term.
    """
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if len(rows) < 5:
        raise InputError(f"'{name}': {len(rows)} lines of numbers, expected 5; is it OCamCalib's calib_results.txt?")
    ss_row = numbers_of_words(rows[0], name, "polynomial")
    if ss_row[0] != ss_row.size - 1:
        raise InputError(
            f"'{name}': {ss_row[0]:g} terms of the polynomial announced, {ss_row.size - 1} given; is the file whole?"
        )
    row, column = numbers_of_words(rows[2], name, "center", 2)
    c, d, e = numbers_of_words(rows[3], name, "affine parameters", 3)
    height, width = image_size(numbers_of_words(rows[4], name, "image size", 2), name, "image size")
    affine = np.array([[c, d], [e, 1.0]])
    return _from_ocam((width, height), -ss_row[1:], np.array([column, row]), affine[::-1, ::-1], name)


def read_py_ocamcalib(text: str, size_px: tuple[int, int], name: str = "calibration.json") -> tuple[Scaramuzza, Mat3]:
    """Return the camera of py-OCamCalib's JSON, and the rotation cam_from_file.

    The file has no image size. Its centre is (column, row), its stretch matrix acts on (right, down), its frame is x
    right, y down, z forward.
    """
    try:
        data = json.loads(text)
        polynomial = numbers(data["taylor_coefficient"], name, "taylor_coefficient")
        centre = numbers(data["distortion_center"], name, "distortion_center", 2)
        stretch = numbers(data["stretch_matrix"], name, "stretch_matrix", 4).reshape(2, 2)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"'{name}': not a calibration of py-OCamCalib ({error}); is the file whole?") from error
    camera, turn = _from_ocam(size_px, polynomial, centre, stretch, name)
    return camera, turn @ np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def camera_of_taylor(
    size_px: tuple[int, int], polynomial: FloatArray, centre: FloatArray, stretch: FloatArray, name: str
) -> Scaramuzza:
    """Return the camera of a polynomial (a0, 0, a2, ...), positive on the axis, and a `stretch` matrix (2, 2) on
    (right, down), as in py-OCamCalib and MATLAB's toolbox; raises InputError for invalid parameters."""
    return _from_ocam(size_px, polynomial, centre, stretch, name)[0]


def _from_ocam(
    size_px: tuple[int, int], polynomial: FloatArray, centre: FloatArray, affine: FloatArray, name: str
) -> tuple[Scaramuzza, Mat3]:
    """Return the camera of a positive polynomial and (u, v) = affine (right, down) + centre, and cam_from_ocam."""
    if polynomial.size - 1 not in DEGREES:
        degrees = f"{DEGREES[0]} to {DEGREES[-1]}"
        raise InputError(f"'{name}': a polynomial of degree {polynomial.size - 1}; it must be of {degrees}")
    if polynomial[0] <= 0.0 or polynomial[1] != 0.0:
        raise InputError(f"'{name}': the polynomial must look forward and have no linear term; is it OCamCalib's?")
    if not abs(np.linalg.det(affine)) > 0.0:
        raise InputError(f"'{name}': the affine parameters put all pixels on one line; is the file whole?")
    # affine = scale [[c, d], [0, 1]] rotation
    scale = float(np.linalg.norm(affine[1]))
    cosine, sine = affine[1, 1] / scale, -affine[1, 0] / scale
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    triangle = affine @ rotation.T / scale
    shape = polynomial * scale ** (1.0 - np.arange(polynomial.size))
    parameters = np.array([*np.delete(shape, 1), *centre, triangle[0, 0], triangle[0, 1]])
    cam_from_ocam = np.zeros((3, 3))
    cam_from_ocam[:2, :2] = rotation @ np.array([[0.0, 1.0], [1.0, 0.0]])
    cam_from_ocam[2, 2] = -1.0
    return cast(Scaramuzza, camera_of("scaramuzza", size_px, parameters, name)), cam_from_ocam


def _scaramuzza(camera: Camera, outline: Pixels | None) -> Written:
    """Return the camera itself, or the refit of the lowest degree that fits."""
    best: Written | None = None
    for degree in (4, 6, 8, 10):
        chosen = best_accepted(camera, (Accepted("scaramuzza", degree),), "OCamCalib", outline)
        if best is None or chosen.max_error_px < 0.5 * best.max_error_px:
            best = chosen
        if best.max_error_px <= ENOUGH_PX:
            break
    assert best is not None
    return best


def _inverse_polynomial(ss: FloatArray, camera: Camera, stretch: float) -> tuple[FloatArray, float]:
    """Return rho as a polynomial of atan(z / r), with z backwards, over the image, and its largest error, px."""
    centre = camera.parameters[-4:-2]
    farther = np.maximum(np.abs(centre), np.abs(np.array(camera.size_px) - 1.0 - centre))
    farthest = float(np.linalg.norm(farther)) * max(abs(stretch), 1.0)
    rho = np.linspace(0.0, farthest, 300)
    z = np.polynomial.polynomial.polyval(rho, ss)
    angle = np.arctan2(z, rho)
    # Beyond the fold rho is no function of the angle.
    rising = np.append(True, np.diff(np.maximum.accumulate(angle)) > 0.0)
    rho, angle = rho[rising], angle[rising]
    best: tuple[FloatArray, float] = (np.zeros(1), np.inf)
    for degree in INVERSE_DEGREES:
        fitted = np.polynomial.Polynomial.fit(angle, rho, degree)
        coefficients = np.asarray(fitted.convert().coef, dtype=np.float64)
        error = float(np.abs(np.polynomial.polynomial.polyval(angle, coefficients) - rho).max())
        if error < best[1]:
            best = (coefficients, error)
        if error <= INVERSE_ENOUGH_PX:
            break
    return best
