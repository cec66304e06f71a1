"""Degrade images by defects of optics, light, sensor, codec and framing.

Each returns the image and the affine map (2, 3) of pixels of the first into it. Levels are 0..255.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.detection.saddles.response import grey_image

Grey = NDArray[np.uint8]
Values = NDArray[np.float32]
Degraded = tuple[NDArray[np.generic], FloatArray]

SAME = np.eye(2, 3)
MOTION_RAD = np.radians(30.0)
GLARE_PART, WEBCAM_PX, OPTICS_PX = 0.15, 1.2, 0.6
"""Standard deviation of a glare's spot as a part of the image's height, of what a webcam sharpens, and of a lens's
blur."""


def eight_bit(image: NDArray[np.generic]) -> Grey:
    """Return `image` in grey levels of a byte: from the darkest to the brightest one where it has more."""
    grey = grey_image(image)
    if grey.dtype == np.uint8:
        return np.asarray(grey, np.uint8)
    low, high = float(grey.min()), float(grey.max())
    return np.asarray(np.rint((grey - np.float32(low)) * np.float32(255.0 / max(high - low, 1e-6))), np.uint8)


def noisy(values: Values, levels: float, rng: np.random.Generator) -> Values:
    return values + np.float32(levels) * rng.standard_normal(values.shape, np.float32)


def faint(values: Values, contrast: float, rng: np.random.Generator) -> Values:
    return noisy(np.float32(128.0) + np.float32(contrast) * (values - np.float32(128.0)), 1.5, rng)


def gamma(values: Values, exponent: float, rng: np.random.Generator) -> Values:
    return np.asarray(255.0 * (values / 255.0) ** exponent, np.float32)


def overexposed(values: Values, times: float, rng: np.random.Generator) -> Values:
    """Return the image of so many times the light: what is brighter than white is cut off."""
    return np.float32(times) * values


def blurred(values: Values, sigma_px: float, rng: np.random.Generator) -> Values:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma_px), np.float32)


def sharpened(values: Values, amount: float, rng: np.random.Generator) -> Values:
    return values + np.float32(amount) * (values - blurred(values, WEBCAM_PX, rng))


def webcam(values: Values, levels: float, rng: np.random.Generator) -> Values:
    return sharpened(noisy(blurred(values, WEBCAM_PX, rng), levels, rng), 3.0, rng)


def moved(values: Values, length_px: float, rng: np.random.Generator) -> Values:
    """Return what a camera sees that turns evenly during the exposure."""
    reach = int(np.ceil(length_px / 2.0)) + 1
    along = np.linspace(-0.5, 0.5, 20 * reach + 1) * length_px
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    u, v = reach + np.cos(MOTION_RAD) * along, reach + np.sin(MOTION_RAD) * along
    for du, dv in ((0, 0), (0, 1), (1, 0), (1, 1)):
        left, top = np.floor(u).astype(int), np.floor(v).astype(int)
        share = np.abs(1 - du - (u - left)) * np.abs(1 - dv - (v - top))
        np.add.at(kernel, (top + dv, left + du), share)
    return np.asarray(cv2.filter2D(values, -1, kernel / kernel.sum()), np.float32)


def salted(values: Values, percent: float, rng: np.random.Generator) -> Values:
    """Return the image with so many pixels in a hundred black or white: a damaged line, a hot sensor."""
    drawn = rng.random(values.shape)
    dark, bright = 0.005 * percent, 1.0 - 0.005 * percent
    return np.asarray(np.where(drawn < dark, 0.0, np.where(drawn > bright, 255.0, values)), np.float32)


def _squared_distance(shape: tuple[int, ...], middle: FloatArray) -> FloatArray:
    v, u = np.ogrid[: shape[0], : shape[1]]
    return np.asarray((u - middle[0]) ** 2 + (v - middle[1]) ** 2, np.float64)


def glare(values: Values, levels: float, rng: np.random.Generator) -> Values:
    height, width = values.shape
    middle = rng.uniform(0.3, 0.7, 2) * (width, height)
    spot = np.exp(-0.5 * _squared_distance(values.shape, middle) / (GLARE_PART * height) ** 2)
    return values + np.asarray(levels * spot, np.float32)


def vignetted(values: Values, remaining: float, rng: np.random.Generator) -> Values:
    """Return the image with only the part `remaining` of its light in the corners."""
    height, width = values.shape
    squared = _squared_distance(values.shape, 0.5 * np.array([width - 1.0, height - 1.0]))
    return values * np.asarray(1.0 - (1.0 - remaining) * squared / squared.max(), np.float32)


def covered(values: Values, most: float, rng: np.random.Generator) -> Values:
    """Return the image with four ellipses across it, of half axes up to the part `most` of its height."""
    height, width = values.shape
    out = values.copy()
    for _ in range(4):
        middle, axes = rng.uniform(0.2, 0.8, 2) * (width, height), rng.uniform(0.02, most, 2) * height
        box = (tuple(middle.tolist()), tuple((2.0 * axes).tolist()), float(rng.uniform(0, 180)))
        cv2.ellipse(out, box, float(rng.uniform(0, 255)), -1)
    return out


def hot(values: Values, columns: float, rng: np.random.Generator) -> Values:
    """Return the image of a sensor with so many columns that are always white."""
    out = values.copy()
    out[:, rng.choice(values.shape[1], int(columns), replace=False)] = 255.0
    return out


def inverted(values: Values, _: float, rng: np.random.Generator) -> Values:
    return np.float32(255.0) - values


def run_over(values: Values, px: float, rng: np.random.Generator) -> Values:
    """Return the image with bright squares that run over into dark ones by `px` (light that saturates, thin print), or,
    where that is negative, dark ones into bright ones (ink that spreads)."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(abs(px)) + 1,) * 2)
    return blurred(np.asarray((cv2.dilate if px > 0.0 else cv2.erode)(values, disc), np.float32), OPTICS_PX, rng)


def shadowed(grey: Grey, through: FloatArray, angle: float, width_px: float, left: float) -> Grey:
    """Return the image under a shadow with a straight edge `through` a pixel, towards `angle`, that leaves the part
    `left` of the light."""
    row, column = np.mgrid[: grey.shape[0], : grey.shape[1]]
    beyond = np.cos(angle) * (column - through[0]) + np.sin(angle) * (row - through[1])
    light = left + (1.0 - left) * 0.5 * (1.0 - np.tanh(2.0 * beyond / width_px))
    return np.asarray(np.clip(np.rint(grey * light), 0, 255), np.uint8)


LIGHT: dict[str, Callable[[Values, float, np.random.Generator], Values]] = {
    "noise": noisy,
    "faint": faint,
    "gamma": gamma,
    "overexposed": overexposed,
    "blur": blurred,
    "sharpened": sharpened,
    "webcam": webcam,
    "motion": moved,
    "glare": glare,
    "salt": salted,
    "vignetting": vignetted,
    "covered": covered,
    "hot columns": hot,
    "inverted": inverted,
    "run over": run_over,
}
"""What changes brightness alone, by name."""


def compressed(grey: Grey, quality: float) -> Degraded:
    coded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)), SAME


def resized(grey: Grey, factor: float) -> Degraded:
    how = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_CUBIC
    out = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=how)
    # OpenCV scales by what it is told, whatever whole number of pixels comes out.
    return np.asarray(out), factor * SAME + np.array([[0.0, 0.0, 1.0]]) * (0.5 * factor - 0.5)


def repeated(grey: Grey, factor: float) -> Degraded:
    """Return the image enlarged by repeating lines, some more often than others."""
    rows, columns = (((np.arange(int(side * factor)) + 0.5) / factor).astype(int) for side in grey.shape)
    return np.ascontiguousarray(grey[rows][:, columns]), factor * SAME + np.array([[0, 0, 1]]) * (0.5 * factor - 0.5)


def turned(grey: Grey, degrees: float) -> Degraded:
    """Return the image turned by a multiple of 90 degrees, counterclockwise as it is seen."""
    quarters = round(degrees / 90.0) % 4
    height, width = grey.shape
    quarter, map_ = np.rot90(grey, quarters), SAME
    for _ in range(quarters):
        # (u, v) goes to (v, width - 1 - u).
        map_ = np.array([[0.0, 1.0], [-1.0, 0.0]]) @ map_ + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, width - 1.0]])
        width, height = height, width
    return np.ascontiguousarray(quarter), map_


def mirrored(grey: Grey) -> Degraded:
    """Return the image as in a mirror: as many webcams show it."""
    map_ = np.array([[-1.0, 0.0, grey.shape[1] - 1.0], [0.0, 1.0, 0.0]])
    return np.ascontiguousarray(grey[:, ::-1]), map_


def cut(grey: Grey, part: float, rng: np.random.Generator) -> Degraded:
    """Return the image without up to the `part` of its left and top."""
    left, top = (int(size * part * rng.random()) for size in grey.shape[::-1])
    return np.ascontiguousarray(grey[top:, left:]), np.column_stack([np.eye(2), [-float(left), -float(top)]])


def deep(grey: Grey, bits: float) -> Degraded:
    """Return the image as a sensor of more than 8 bits stores it in 16: its brightest value far below the largest."""
    return grey.astype(np.uint16) * np.uint16(2 ** (int(bits) - 8)), SAME


FRAME: dict[str, Callable[[Grey, float, np.random.Generator], Degraded]] = {
    "jpeg": lambda grey, quality, _: compressed(grey, quality),
    "size": lambda grey, factor, _: resized(grey, factor),
    "repeated": lambda grey, factor, _: repeated(grey, factor),
    "turned": lambda grey, degrees, _: turned(grey, degrees),
    "mirrored": lambda grey, _, __: mirrored(grey),
    "cut": cut,
    "bits": lambda grey, bits, _: deep(grey, bits),
}
"""What changes more than brightness, by name."""


def degraded(name: str, amount: float, grey: Grey, rng: np.random.Generator) -> Degraded:
    """Return `grey` with the degradation `name` of that `amount`, and the map of its pixels."""
    if name in FRAME:
        return FRAME[name](grey, amount, rng)
    values = LIGHT[name](grey.astype(np.float32), amount, rng)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8), SAME
