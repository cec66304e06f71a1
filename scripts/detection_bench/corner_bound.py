"""Compute the Cramer-Rao bound of every corner of a rendered scene.

The image of a corner has nine unknowns: its position (2), the directions of the two lines (2), the blur (1), and
brightness, contrast and the light's gradient (4). They are estimated from the pixels of its cell: those closer to it,
along the cell's sides, than to its neighbours. Assumed known: lines are straight except for distortion, blur and noise
are constant over the cell, and the noise level. Each corner has its own bound; a common plane and lens are not used.
The bound is for unbiased estimators without priors: one that expects angles close to those of the board's rows, or
nearly uniform light, may be slightly below it on small, foreshortened, noisy squares.

The derivatives are differences of rendered images, noise-free and before rounding: the scene moved by a fraction of a
pixel along u and v, and blurred a little more or less. Moving one line only is a shear of the image along the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from detection_bench.scenes import BENCH_PHOTOMETRY, BenchScene
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.detection.subpixel.edge_fit import ROUNDING_VARIANCE
from rigkit.synthetic.photometry import develop
from rigkit.synthetic.render import Optics

SHIFT_PX = 0.07
"""Half width of the differences: the third derivative of an edge of blur 0.3 adds less than one per cent."""
BLUR_STEP_PX = 0.02
HALF_CELL = 0.5
"""Pixels of a cell: up to this from the corner along both sides."""
PARAMETERS = 9


def corner_information(scene: BenchScene, blur_px: float) -> tuple[FloatArray, ...]:
    """Return for each board of `scene.truth()` the Fisher information (N, 9, 9) of its corners at noise of variance 1
    (grey levels squared); the first two parameters are u and v, px.

    Divide by the noise's variance, ROUNDING_VARIANCE included. NaN where a cell holds too few pixels.
    """
    pictures = changing_pictures(scene, blur_px)
    return tuple(_of_board(detection, pictures) for detection in scene.truth())


def changing_pictures(scene: BenchScene, blur_px: float) -> FloatArray:
    """Return the noise-free picture and how it changes, (4, H, W): along u, along v, with the blur, and itself."""
    slopes = []
    for axis in (0, 1):
        before, after = (noise_free_levels(shifted_scene(scene, axis, sign * SHIFT_PX), blur_px) for sign in (-1, 1))
        slopes.append((after - before) / (2.0 * SHIFT_PX))
    sharper, wider = (noise_free_levels(scene, blur_px + sign * BLUR_STEP_PX) for sign in (-1, 1))
    return np.stack([*slopes, (wider - sharper) / (2.0 * BLUR_STEP_PX), 0.5 * (wider + sharper)])


def position_bound(information: FloatArray, noise_levels: float) -> FloatArray:
    """Return the smallest covariances (N, 2, 2) of the position, px^2, for noise (grey levels) and rounding."""
    variance = noise_levels**2 + ROUNDING_VARIANCE
    known = np.isfinite(information).all(axis=(1, 2))
    out = np.full((len(information), 2, 2), np.nan)
    out[known] = np.linalg.inv(information[known])[:, :2, :2] * variance
    return out


def noise_free_levels(scene: BenchScene, blur_px: float) -> FloatArray:
    """Return the noise-free picture in grey levels, not rounded."""
    picture = scene.radiance(Optics(blur_px))
    # The light is the same whatever is in the picture: that of a white one, in steps of 1/257 of a level.
    light = develop(np.ones_like(picture), replace(BENCH_PHOTOMETRY, bits=16)) / 257.0
    return picture * light


def shifted_scene(scene: BenchScene, axis: int, by_px: float) -> BenchScene:
    """Return the scene with its whole picture moved along u (axis 0) or v (axis 1)."""
    names = list(scene.camera.parameter_names())
    centre = ("cx", "cy")[axis]
    if centre not in names:
        raise InputError(f"corner bound: a {scene.camera.model} camera has no {centre} to shift the picture by")
    parameters = scene.camera.parameters.copy()
    parameters[names.index(centre)] += by_px
    return replace(scene, camera=scene.camera.with_parameters(parameters))


def _of_board(detection: BoardDetection, pictures: FloatArray) -> FloatArray:
    lattice = detection.lattice()
    columns = [_centred(lattice, axis) for axis in (1, 0)]
    out = np.full((len(detection.grid), PARAMETERS, PARAMETERS), np.nan)
    for n, ((column, row), centre) in enumerate(zip(detection.grid, detection.pixels, strict=True)):
        sides = np.stack([step[row, column] for step in columns])
        rows = derivatives_around(centre, sides, pictures, _in_cell)
        if rows.shape[1] > PARAMETERS:
            out[n] = rows @ rows.T
    return out


def _in_cell(cells: FloatArray) -> BoolArray:
    return np.asarray((np.abs(cells) <= HALF_CELL).all(axis=0))


def _centred(lattice: FloatArray, axis: int) -> FloatArray:
    """Return the cell's side (rows, columns, 2) along columns (axis 1) or rows (axis 0), px, one-sided at the ends."""
    step = np.diff(lattice, axis=axis)
    pad = np.full_like(np.take(step, [0], axis=axis), np.nan)
    before, after = np.concatenate([pad, step], axis=axis), np.concatenate([step, pad], axis=axis)
    mean = np.where(np.isnan(before), after, np.where(np.isnan(after), before, 0.5 * (before + after)))
    return np.asarray(mean)


def pixels_around(centre: FloatArray, reach: FloatArray, pictures: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the pixels of `pictures` (K, H, W) within `reach` (2,) of `centre` along u and v: their offsets (2, P)
    from it and values (K, P); None where there are none, or `reach` is not finite."""
    if not np.isfinite(reach).all():
        return None
    height, width = pictures.shape[1:]
    low = np.maximum(np.ceil(centre - reach), 0).astype(int)
    high = np.minimum(np.floor(centre + reach), [width - 1, height - 1]).astype(int)
    if (high < low).any():
        return None
    v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
    offset = np.stack([u.ravel() - centre[0], v.ravel() - centre[1]])
    return offset, pictures[:, low[1] : high[1] + 1, low[0] : high[0] + 1].reshape(len(pictures), -1)


def derivatives_around(
    centre: FloatArray,
    sides: FloatArray,
    pictures: FloatArray,
    within: Callable[[FloatArray], BoolArray],
    reach_sides: float = HALF_CELL,
) -> FloatArray:
    """Return the derivatives (PARAMETERS, P) of pixels round `centre` by what the image of a corner depends on.

    `within` says which places (2, N), in `sides` (2, 2) from the corner, are looked at, up to `reach_sides` of these.
    """
    reach = reach_sides * np.abs(sides).sum(axis=0)
    window = pixels_around(centre, reach, pictures)
    if window is None:
        return np.zeros((PARAMETERS, 0))
    offset, cut = window
    cells = np.asarray(np.linalg.solve(sides.T, offset), np.float64)
    inside = within(cells)
    by_u, by_v, by_blur, light = cut[:, inside]
    du, dv = offset[:, inside]
    # To turn line 1 alone, points move along line 2 in proportion to how far out along line 1 they are.
    turns = [
        cells[k, inside] * (by_u * sides[1 - k, 0] + by_v * sides[1 - k, 1]) / np.linalg.norm(sides[1 - k])
        for k in (0, 1)
    ]
    size = float(np.linalg.norm(reach))
    return np.stack([by_u, by_v, *turns, by_blur, np.ones_like(light), light, light * du / size, light * dv / size])
