"""What the detector asks the kernels of `rigkit.kernels.front` for, in numpy and OpenCV, with the same arguments.

The tolerances are those of the detector, whatever the rules say.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.saddles import ring
from rigkit.detection.saddles.response import (
    EXTREME,
    MIN_SPAN,
    NOISE_FACTOR,
    SMOOTH,
    THRESHOLD_CEILING,
    THRESHOLD_FLOOR,
    FloatImage,
    GreyImage,
    sample,
)
from rigkit.detection.saddles.ring import CIRCLE, GAINS, MAX_CENTRE, MAX_COSINE, MAX_ODD, _gains
from rigkit.detection.saddles.saddle import MAX_STEP
from rigkit.kernels.front import (
    HALF,
    STRIP,
    STRIP_ROWS,
    STRIPS_FROM,
    CornersOfLevel,
    LevelRules,
    RingRules,
)

QUICK = 4
"""Every so many samples of a ring are looked at before it is read."""


def shrunk(image: GreyImage, factor: int) -> FloatImage:
    height, width = image.shape[0] // factor, image.shape[1] // factor
    whole = image[: factor * height, : factor * width]
    mean = cv2.resize(whole.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, np.float32)


def smoothed(image: GreyImage, kernel: FloatImage) -> tuple[FloatImage, FloatImage]:
    smooth = np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)
    return smooth, np.ascontiguousarray(smooth[::2, ::2])


def level(image: GreyImage, rules: LevelRules, step: int) -> tuple[FloatImage, FloatImage, FloatImage]:
    smooth, half = smoothed(image, SMOOTH)
    median_level, darkest, brightest = typical(smooth, step, EXTREME)
    contrast = (max(brightest - darkest, MIN_SPAN) / 200.0) ** 2
    noise = min(NOISE_FACTOR * median_level, THRESHOLD_CEILING * contrast)
    return smooth, half, thresholds(smooth, THRESHOLD_FLOOR * contrast, noise, darkest, brightest)


def thresholds(smooth: FloatImage, floor: float, least: float, darkest: float, brightest: float) -> FloatImage:
    height, width = smooth.shape
    most = np.full((height // STRIP_ROWS + 1, width // STRIP + 1), darkest)
    for band, strip in np.ndindex(most.shape):
        left = STRIPS_FROM + strip * STRIP
        part = smooth[band * STRIP_ROWS : (band + 1) * STRIP_ROWS : 4, left : left + STRIP : 4]
        most[band, strip] = part.max(initial=darkest)
    part = np.where(most < brightest, (most - darkest) / (brightest - darkest if brightest > darkest else 1.0), 1.0)
    return np.asarray(np.maximum(floor * part**2, least), np.float32)


def threshold_at(above: FloatImage, u: IntArray, v: IntArray) -> FloatImage:
    """Return the threshold of pixels (u, v) of a level."""
    return np.asarray(above[v // STRIP_ROWS, np.maximum(u - STRIPS_FROM, 0) // STRIP], np.float32)


def typical(smooth: FloatImage, step: int, extreme: float) -> tuple[float, float, float]:
    response = np.sort(np.abs(_response(smooth)[::step, ::step]), axis=None)
    brightness = np.sort(smooth[1:-1:step, 1:-1:step], axis=None)
    few = int(extreme * len(brightness))
    return float(response[len(response) // 2]), float(brightness[few]), float(brightness[-1 - few])


def peaks(smooth: FloatImage, above: FloatImage, limit: int, side: int, finest: int) -> tuple[IntArray, FloatImage]:
    response = _response(smooth)
    # What overflows twice is no number: a maximum with it is another one on each processor, and no peak.
    response = np.where(np.isnan(response), np.float32(-np.inf), response)
    highest = cv2.dilate(response, np.ones((5, 5), np.uint8))
    mask = (response >= highest) & (
        response > threshold_at(above, 1 + np.arange(response.shape[1]), 1 + np.arange(len(response))[:, None])
    )
    mask[:2] = mask[-2:] = False
    mask[:, :2] = mask[:, -2:] = False
    flat = np.flatnonzero(mask)
    flat = flat[~_repeated(response.ravel(), flat, response.shape[1])]
    v, u = np.divmod(flat, response.shape[1])
    places, heights = np.stack([u, v], axis=-1) + 1, response.ravel()[flat]
    kept = _strongest(places, heights, limit, side, finest) if len(places) > limit else slice(None)
    return places[kept], heights[kept]


def corners(
    smooth: FloatImage,
    at: IntArray,
    response: FloatImage,
    tests: tuple[float, float, float],
    rules: RingRules,
    to_full: tuple[float, float],
    known: FloatArray,
    reach: float,
) -> CornersOfLevel:
    radius, max_step, max_sharp = tests
    assert max_step == MAX_STEP and rules.max_odd == MAX_ODD
    found, near = saddle_step(smooth, at)
    found, response = found[near], response[near]
    which = np.flatnonzero(may_be_corners(smooth, found, radius, response))
    rings = read_rings(smooth, found[which], radius)
    good = rings.valid & (response[which] <= max_sharp * rings.contrast**2)
    scale, offset = to_full
    full = scale * found + offset
    pixels = full[which[good]]
    repeated = near_any(pixels, known, reach) if len(known) else np.zeros(len(pixels), np.bool_)
    return CornersOfLevel(full, pixels, rings.angles[good], rings.contrast[good], rings.smeared[good], repeated)


def near_any(fresh: FloatArray, known: FloatArray, reach: float) -> BoolArray:
    return np.asarray(cKDTree(known).query(fresh)[0] <= reach, dtype=np.bool_)


def _response(smooth: FloatImage) -> FloatImage:
    """Return D of the inner pixels of `smooth` (H, W), (H - 2, W - 2)."""
    second = np.array([1.0, -2.0, 1.0], np.float32)
    first = np.array([-0.5, 0.0, 0.5], np.float32)
    lxx = cv2.filter2D(smooth, cv2.CV_32F, second[None])
    lyy = cv2.filter2D(smooth, cv2.CV_32F, second[:, None])
    lxy = cv2.sepFilter2D(smooth, cv2.CV_32F, first, first)
    # In place: fresh pages of memory cost as much as the arithmetic.
    cv2.multiply(lxx, lyy, dst=lxx)
    cv2.multiply(lxy, lxy, dst=lxy)
    return np.asarray(cv2.subtract(lxy, lxx, dst=lxy), np.float32)[1:-1, 1:-1]


def _strongest(at: IntArray, height: FloatImage, most: int, side: int, shares: int) -> BoolArray:
    """Return which of the peaks `at` (N, 2) of `height` (N,) are the `most` strongest in their surroundings.

    More where the last ones are equally strong.
    """
    column, row = (at // side).T
    square = row * (int(column.max()) + 1) + column
    strongest = np.zeros(int(square.max()) + 1, np.float32)
    np.maximum.at(strongest, square, height)
    # Beyond what float32 holds one is as strong as the other.
    share = (np.float32(shares) * np.nan_to_num(height / strongest[square], nan=1.0)).astype(np.int64)
    at_least = np.cumsum(np.bincount(share, minlength=shares + 1)[::-1])[::-1]
    return np.asarray(share >= np.flatnonzero(at_least >= most)[-1], np.bool_)


def _repeated(response: FloatImage, flat: IntArray, width: int) -> BoolArray:
    """Return which peaks have an equal one before them in their neighbourhood: a corner between pixels makes two."""
    value = response[flat]
    repeated = np.zeros(len(flat), bool)
    for dv, du in ((0, -1), (0, -2), *((dv, du) for dv in (-1, -2) for du in (-2, -1, 0, 1, 2))):
        repeated |= response[flat + dv * width + du] == value
    return repeated


def saddle_step(smooth: FloatImage, at: IntArray) -> tuple[FloatArray, BoolArray]:
    """Return the stationary point next to each of the pixels `at` (N, 2), and whether it is a saddle and near."""
    u, v = at[:, 0], at[:, 1]
    patch = {(i, j): smooth[v + j, u + i].astype(np.float64) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    gu, gv = 0.5 * (patch[1, 0] - patch[-1, 0]), 0.5 * (patch[0, 1] - patch[0, -1])
    huu = patch[1, 0] + patch[-1, 0] - 2.0 * patch[0, 0]
    hvv = patch[0, 1] + patch[0, -1] - 2.0 * patch[0, 0]
    huv = 0.25 * (patch[1, 1] + patch[-1, -1] - patch[1, -1] - patch[-1, 1])
    det = huu * hvv - huv**2
    safe = np.where(det < 0.0, det, -1.0)
    step = np.stack([(huv * gv - hvv * gu) / safe, (huv * gu - huu * gv) / safe], axis=-1)
    near = (det < 0.0) & (np.abs(step).max(axis=1) <= MAX_STEP)
    return at + step, near


HARMONICS = [np.exp(-1j * m * np.arange(HALF) * (np.pi / HALF)).astype(np.complex64) for m in (2, 4)]


@dataclass(frozen=True, eq=False, slots=True)
class Rings:
    """What the rings around N points say.

    Attributes
    ----------
    angles : (N, 2) rad, lines A and B as in `Corners`.
    contrast : (N,) bright minus dark, grey levels.
    valid : (N,) looks like a chessboard corner; the other values are undefined elsewhere.
    smeared : (N,) only motion explains how bright the middle is.
    """

    angles: FloatArray
    contrast: FloatArray
    valid: BoolArray
    smeared: BoolArray


def may_be_corners(image: FloatImage, pixels: FloatArray, radius_px: float, response: FloatImage) -> BoolArray:
    """Return which of `pixels` (N, 2), where the saddle response is `response` (N,), are worth to be read a ring of."""
    places = pixels.astype(np.float32)
    values = sample(image, places[:, None, :] + np.float32(radius_px) * CIRCLE[::QUICK])
    one, other = np.split(values, 2, axis=1)
    even = 0.5 * (one + other)
    mean = even.mean(axis=1)
    variance = even.var(axis=1)
    odd = 0.25 * ((one - other) ** 2).mean(axis=1)
    off = np.abs(sample(image, places) - mean)
    most = np.where(odd < ring.EVEN_ODD * variance, ring.QUICK_EVEN_CENTRE, ring.QUICK_CENTRE)
    return np.asarray(
        (odd < ring.QUICK_ODD * variance) & (off**2 < most**2 * variance) & (response < ring.QUICK_SHARP * variance)
    )


def read_rings(
    image: FloatImage,
    pixels: FloatArray,
    radius_px: FloatArray | float,
    max_odd: float = MAX_ODD,
    max_centre: float = MAX_CENTRE,
) -> Rings:
    """Return what rings of `radius_px` (scalar or (N,)) around `pixels` (N, 2) of `image` look like."""
    radius = np.broadcast_to(np.asarray(radius_px, np.float32), pixels.shape[:1])
    values = sample(image, pixels[:, None, :].astype(np.float32) + radius[:, None, None] * CIRCLE)
    even = 0.5 * (values[:, :HALF] + values[:, HALF:])
    odd = 0.5 * (values[:, :HALF] - values[:, HALF:])
    low, high = even.min(axis=1), even.max(axis=1)
    contrast = (high - low).astype(np.float64)
    middle = 0.5 * (low + high)
    mean = even.mean(axis=1)
    spread = even - mean[:, None]
    odd_energy, energy = (odd**2).sum(axis=1), (spread**2).sum(axis=1)
    off = np.abs(sample(image, pixels) - mean) / (high - low)
    smeared = ~(off < max_centre)
    balanced = ~smeared | ((off < max(ring.EVEN_CENTRE, max_centre)) & (odd_energy < ring.EVEN_ODD * energy))
    above = even > middle[:, None]
    valid = (
        (odd_energy < max_odd * energy)
        & balanced
        & (np.count_nonzero(~above & np.roll(above, -1, axis=1), axis=1) == 1)
    )
    angles = np.zeros((len(pixels), 2))
    angles[valid] = _angles(image, pixels[valid], radius[valid], even[valid])
    return Rings(angles, contrast, valid, smeared)


def _angles(image: FloatImage, pixels: FloatArray, radius: FloatImage, even: FloatImage) -> FloatArray:
    """Return the angles of lines A and B (N, 2) from the `even` parts (N, HALF) of rings of `radius` (N,)."""
    second, fourth = (even @ wave for wave in HARMONICS)
    inner = sample(image, pixels[:, None, :].astype(np.float32) + 0.5 * radius[:, None, None] * CIRCLE[::2])
    size = np.maximum(np.abs(second), 1e-20)
    phase = second / size
    nearer = (0.5 * (inner[:, : HALF // 2] + inner[:, HALF // 2 :])) @ HARMONICS[0][::2]
    gain = np.interp(2.0 * (nearer * phase.conj()).real / size, np.linspace(0.25, 1.0, GAINS), _gains())
    cosine = gain * (fourth * phase.conj() ** 2).real / size
    half = 0.5 * np.arccos(np.clip(cosine, -MAX_COSINE, MAX_COSINE))
    first = (-0.5 * np.angle(phase) - half) % np.pi
    return np.stack([first, first + 2.0 * half], axis=-1)
