"""The model of a tag of tags.c by sampling: no series, no edges, only which cells the places of many points lie in."""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray

SAMPLES = 16
"""A pixel along u and along v."""


def picture(
    size_px: tuple[int, int],
    polynomials: FloatArray,
    centre: FloatArray,
    scale: float,
    moves: FloatArray,
    ink: BoolArray,
    breaks: FloatArray,
    blur_px: float,
    paper: float,
    contrast: float,
) -> FloatArray:
    """Return the brightness (height, width) of what `kernels.tags.fit_tags` is projected of, corners off by `moves`
    (4, 2).

    `blur_px` is of lens and pixel together.
    """
    width, height = size_px
    u, v = np.meshgrid(*[(np.arange(SAMPLES * n) + 0.5) / SAMPLES - 0.5 for n in (width, height)])
    # A corner that has moved by d shows at p what was at p - share d.
    x, y = _place(polynomials, u - centre[0], v - centre[1], scale)
    share = np.stack([(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y], axis=-1)
    off = share @ moves
    x, y = _place(polynomials, u - centre[0] - off[..., 0], v - centre[1] - off[..., 1], scale)
    dark = ink[np.searchsorted(breaks, y), np.searchsorted(breaks, x)].astype(np.float64)
    # Beside the square of the pixel, which the mean over the samples makes.
    lens = SAMPLES * np.sqrt(blur_px**2 - 1.0 / 12.0)
    blurred = cv2.GaussianBlur(dark, (0, 0), lens, borderType=cv2.BORDER_REPLICATE)
    share_of_ink = blurred.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
    return np.asarray(paper - contrast * share_of_ink)


def _place(polynomials: FloatArray, du: FloatArray, dv: FloatArray, scale: float) -> FloatArray:
    u, v = du / scale, dv / scale
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3])
    return np.asarray(np.tensordot(polynomials, terms, axes=1))
