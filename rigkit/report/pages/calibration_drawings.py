"""Drawings of a calibration: residuals, their local means, coverage, and the uncertainty map.

Each is an SVG followed by its caption (HTML).
"""

from __future__ import annotations

from html import escape

import numpy as np

from rigkit.calibration.certainty.coverage import outline_of_corners
from rigkit.calibration.certainty.uncertainty import projection_uncertainty, uncertainty_map
from rigkit.calibration.result import Calibration
from rigkit.cameras.compare import grid_pixels
from rigkit.core.arrays import FloatArray, sampling_step
from rigkit.report import svg
from rigkit.report.svg import DRAWN_WIDTH, INK, MARK, SOFT, WRONG, dots, round_down, strokes

FOOT = 24.0
"""Height below the image for a scale or a colour bar."""
MAX_VECTORS = 5000
"""Maximum number of residuals drawn; more are subsampled."""
RMS_LENGTH = 0.02
"""Drawn length of the RMS residual, as a fraction of the image's width."""
CELLS_ACROSS = 16
MIN_IN_CELL = 4
"""Minimum number of corners of a mean."""
CELL_CHANCE = 0.01
"""Significance level of a cell's mean."""
MAP_GRID = (40, 30)
MAP_PX = (0.003, 10.0)
"""Ends of the logarithmic colour scale of all uncertainty maps, so that maps can be compared."""
CONTOURS_PX = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
ARROW_HEAD = 3.2
"""Length of the strokes of an arrow's head, in units of the drawing."""
VIRIDIS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=float)


def residuals_svg(calibration: Calibration) -> str:
    """Draw the magnified residual of each corner; outliers are crosses."""
    corners, (pixels, residuals) = calibration.corners, calibration.corners.used
    times = round_down(RMS_LENGTH * calibration.camera.size_px[0] / max(calibration.rms_px, 1e-9))
    step = sampling_step(len(pixels), MAX_VECTORS)
    q, d = pixels[::step], residuals[::step]
    words = f"{len(q)} residuals, measured minus projected, magnified {times:g} times"
    words += f" (every {_ordinal(step)} drawn)" if step > 1 else ""
    crossed = corners.pixels[~corners.kept]
    zoom = _zoom(calibration)
    out = [
        _opening(calibration, words),
        f'<path d="{strokes(zoom * q, zoom * times * d)}" stroke="{INK}" stroke-width="1" fill="none"/>',
        f'<path d="{dots(zoom * q)}" stroke="{INK}" stroke-width="2.2" stroke-linecap="round"/>',
        f'<path d="{_crosses(zoom * crossed)}" stroke="{WRONG}" stroke-width="1.2" fill="none"/>',
        _scale(calibration, times),
        _ending(
            calibration, words, f"crosses: {len(crossed)} corners left out" if len(crossed) else "no corner left out"
        ),
    ]
    return "".join(out)


def pattern_svg(calibration: Calibration) -> str:
    """Draw the mean residual of each cell of the image. Noise gives short grey arrows; a lens or board that the model
    does not fit gives long coloured ones that agree with their neighbours."""
    pixels, residuals = calibration.corners.used
    width, height = calibration.camera.size_px
    size = width / CELLS_ACROSS
    cell = (pixels / size).astype(np.int64).clip(0)
    rows = int(np.ceil(height / size))
    index = cell[:, 1].clip(max=rows - 1) * CELLS_ACROSS + cell[:, 0].clip(max=CELLS_ACROSS - 1)
    cells = rows * CELLS_ACROSS
    count = np.bincount(index, minlength=cells)
    total = np.stack([np.bincount(index, weights=r, minlength=cells) for r in residuals.T], axis=-1)
    squared = np.bincount(index, weights=(residuals**2).sum(axis=1), minlength=cells)
    enough = count >= MIN_IN_CELL
    mean = total[enough] / count[enough, None]
    # Corners near the border scatter more: each cell is tested by its own scatter about its mean.
    freedom = 2.0 * (count[enough] - 1.0)
    own = np.sqrt((squared[enough] - count[enough] * (mean**2).sum(axis=1)).clip(0.0) / freedom)
    reach = np.sqrt(freedom * (CELL_CHANCE ** (-2.0 / freedom) - 1.0))
    beyond = np.linalg.norm(mean, axis=1) > own / np.sqrt(count[enough]) * reach
    row, column = np.divmod(np.flatnonzero(enough), CELLS_ACROSS)
    places = (np.stack([column, row], axis=-1) + 0.5) * size
    longest = float(np.linalg.norm(mean, axis=1).max(initial=1e-9))
    times = round_down(0.9 * size / longest)
    words = f"mean residual by part of the image, magnified {times:g} times"
    zoom = _zoom(calibration)
    marks = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.4" fill="{SOFT}"/>' for x, y in zoom * places)
    out = [_opening(calibration, words), marks]
    for chosen, colour in ((~beyond, SOFT), (beyond, MARK)):
        start, by = zoom * places[chosen], zoom * times * mean[chosen]
        path = strokes(start, by) + _arrow_heads(start, by)
        out.append(f'<path d="{path}" stroke="{colour}" stroke-width="1.6" fill="none"/>')
    expected = f"{int(beyond.sum())} of {len(beyond)} significant (coloured; {CELL_CHANCE * len(beyond):.1f} by chance)"
    return "".join([*out, _scale(calibration, times), _ending(calibration, words, expected)])


def coverage_svg(calibration: Calibration) -> str:
    """Draw every corner used, over cells whose darkness is their number of corners."""
    pixels, _ = calibration.corners.used
    width, height = calibration.camera.size_px
    columns, rows = 12, max(round(12 * height / width), 1)
    size = np.array([width / columns, height / rows])
    i, j = ((pixels + 0.5) / size).astype(np.int64).clip(0, [columns - 1, rows - 1]).T
    count = np.bincount(i * rows + j, minlength=columns * rows).reshape(columns, rows)
    zoom = _zoom(calibration)
    w, h = zoom * width / columns, zoom * height / rows
    out = [_opening(calibration, "coverage of the image by corners")]
    for i, j in np.ndindex(columns, rows):
        if count[i, j]:
            shade = 0.08 + 0.42 * min(count[i, j] / max(np.quantile(count[count > 0], 0.9), 1.0), 1.0)
            place = f'x="{i * w:.1f}" y="{j * h:.1f}" width="{w:.1f}" height="{h:.1f}"'
            out.append(f'<rect {place} fill="{INK}" fill-opacity="{shade:.2f}"/>')
    step = sampling_step(len(pixels), MAX_VECTORS)
    out.append(f'<path d="{dots(zoom * pixels[::step])}" stroke="{MARK}" stroke-width="2.2" stroke-linecap="round"/>')
    middles = (np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), axis=-1) + 0.5) * size - 0.5
    seen = calibration.camera.unproject(middles)[1] | (count > 0)
    empty = int((seen & (count == 0)).sum())
    words = f"{len(pixels)} corners of {len(calibration.views)} boards seen"
    return "".join(
        [*out, _ending(calibration, words, f"{empty} of the {int(seen.sum())} cells in the field of view are empty")]
    )


def uncertainty_svg(calibration: Calibration) -> str:
    """Draw the uncertainty of a far point's projection over the image: one standard deviation, worst direction."""
    width, height = calibration.camera.size_px
    grid = uncertainty_map(calibration, grid=MAP_GRID)
    known = np.isfinite(grid.worst_px)
    if not known.any() or not np.nanmin(grid.worst_px) > 0.0:
        return "".join(
            [_opening(calibration, "uncertainty"), _ending(calibration, "the projection has no uncertainty", "")]
        )
    low, high = MAP_PX
    level = np.log(np.where(known, grid.worst_px, low) / low) / np.log(high / low)
    zoom = _zoom(calibration)
    w, h = zoom * width / MAP_GRID[0], zoom * height / MAP_GRID[1]
    best, worst = float(np.nanmin(grid.worst_px)), float(np.nanmax(grid.worst_px))
    words = f"{best:.3g} px at best, {worst:.3g} px at worst (a point at infinity, worst direction)"
    out = [_opening(calibration, "projection uncertainty, px"), '<g shape-rendering="crispEdges">']
    for j, i in np.argwhere(known):
        place = f'x="{i * w:.1f}" y="{j * h:.1f}" width="{w + 0.2:.1f}" height="{h + 0.2:.1f}"'
        out.append(f'<rect {place} fill="{_colour(float(level[j, i]))}"/>')
    out += ["</g>", _contours(grid.worst_px, w, h), _colour_bar(zoom * height + 7.0, low, high)]
    outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in zoom * outline_of_corners(calibration))
    out.append(f'<polygon points="{outline}" fill="none" stroke="#fff" stroke-width="1.5" stroke-dasharray="6 4"/>')
    out += _numbers(calibration)
    return "".join(
        [*out, _ending(calibration, words, "dashed: hull of all corners; outside the lens model extrapolates")]
    )


def _contours(worst_px: FloatArray, cell_width: float, cell_height: float) -> str:
    """Return contour lines of the uncertainty with labels."""
    from contourpy import contour_generator

    rows, columns = worst_px.shape
    x, y = (np.arange(columns) + 0.5) * cell_width, (np.arange(rows) + 0.5) * cell_height
    thirds = np.linspace(0.0, 1.0, 3)
    figures = np.stack(np.meshgrid(thirds * columns * cell_width, thirds * rows * cell_height), axis=-1).reshape(-1, 2)
    generator = contour_generator(x, y, np.ma.masked_invalid(np.log(worst_px)))
    out = []
    for value in CONTOURS_PX:
        lines = [np.asarray(line) for line in generator.lines(float(np.log(value)))]
        for line in lines:
            out.append(f'<path d="{svg.line(line)}" fill="none" stroke="#fff" stroke-opacity=".75" stroke-width="1"/>')
        if lines:
            # The label is placed far from the figures on the map.
            longest = max(lines, key=len)
            a, b = longest[np.linalg.norm(longest[:, None] - figures, axis=-1).min(axis=1).argmax()]
            out.append(f'<text x="{a:.1f}" y="{b:.1f}" font-size="12.5" fill="#fff">{value:g}</text>')
    return "".join(out)


def _scale(calibration: Calibration, times: float) -> str:
    """Return a scale bar of a round number of pixels, magnified as the residuals."""
    per_px = _zoom(calibration) * times
    length = round_down(0.15 * DRAWN_WIDTH / per_px)
    y, x = _zoom(calibration) * calibration.camera.size_px[1] + 12.0, DRAWN_WIDTH - 4.0
    return (
        f'<path d="M{x - length * per_px:.1f} {y:.1f}H{x}m0 -4v8m{-length * per_px:.1f} 0v-8" stroke="#333"/>'
        + svg.label(x - length * per_px - 6, y + 4, f"{length:g} px", "end")
    )


def _arrow_heads(start: FloatArray, by: FloatArray) -> str:
    """Return arrow heads of two strokes each, without those of short arrows."""
    length = np.linalg.norm(by, axis=-1, keepdims=True)
    long = length[:, 0] > 1.5 * ARROW_HEAD
    tip, along = (start + by)[long], (by / np.maximum(length, 1e-12))[long]
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    one, two = (ARROW_HEAD * (-along + side * 0.6 * across) for side in (1.0, -1.0))
    return "".join(
        f"M{x + a:.1f} {y + b:.1f}L{x:.1f} {y:.1f}l{c:.1f} {d:.1f}"
        for (x, y), (a, b), (c, d) in zip(tip, one, two, strict=True)
    )


def _colour_bar(y: float, low: float, high: float) -> str:
    """Return the colour bar of the map from `low` to `high` px, logarithmic."""
    levels = np.linspace(0.0, 1.0, 24)
    strip = "".join(
        f'<rect x="{380 + 6 * k}" y="{y:.1f}" width="7" height="10" fill="{_colour(v)}"/>' for k, v in enumerate(levels)
    )
    return svg.label(374, y + 10, f"{low:.3g}", "end") + strip + svg.label(530, y + 10, f"{high:.3g} px")


def _numbers(calibration: Calibration) -> list[str]:
    """Return labels of the uncertainty at the centre, the corners and the middles of the sides."""
    at = grid_pixels(calibration.camera.size_px, (3, 3))
    worst = projection_uncertainty(calibration, at).worst_px
    zoom = _zoom(calibration)
    out = []
    for j, i in np.ndindex(3, 3):
        words = f"{worst[j, i]:.3g}" if np.isfinite(worst[j, i]) else "no ray"
        x, y = (float(c) for c in zoom * at[j, i])
        anchor = ("start", "middle", "end")[i]
        out.append(
            f'<text x="{x + (6, 0, -6)[i]:.1f}" y="{y + (17, 5, -8)[j]:.1f}" text-anchor="{anchor}" font-size="14" '
            f'font-weight="600" fill="#111" stroke="#fff" stroke-width="3" paint-order="stroke">{words}</text>'
        )
    return out


def _zoom(calibration: Calibration) -> float:
    return DRAWN_WIDTH / calibration.camera.size_px[0]


def _ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def _crosses(at: FloatArray) -> str:
    return "".join(f"M{x - 4.0:.1f} {y - 4.0:.1f}l8.0 8.0m0 -8.0l-8.0 8.0" for x, y in at)


def _colour(level: float) -> str:
    place = np.clip(level, 0.0, 1.0) * (len(VIRIDIS) - 1)
    red, green, blue = (np.interp(place, np.arange(len(VIRIDIS)), channel) for channel in VIRIDIS.T)
    return f"#{round(float(red)):02x}{round(float(green)):02x}{round(float(blue)):02x}"


def _opening(calibration: Calibration, title: str) -> str:
    height = _zoom(calibration) * calibration.camera.size_px[1]
    return (
        svg.opening_tag(title, f"-1 -1 {DRAWN_WIDTH + 2:g} {height + FOOT:.1f}")
        + f'<rect width="{DRAWN_WIDTH:g}" height="{height:.1f}" fill="{svg.GROUND_COLOUR}"/>'
    )


def _ending(calibration: Calibration, *lines: str) -> str:
    """Return the end of the drawing with a frame, and the caption as HTML, which stays legible in small drawings."""
    height = _zoom(calibration) * calibration.camera.size_px[1]
    words = "<br>".join(escape(line) for line in lines if line)
    return (
        f'<rect width="{DRAWN_WIDTH:g}" height="{height:.1f}" fill="none" stroke="{svg.RIM_COLOUR}"/></svg>'
        f'<p class="foot">{words}</p>'
    )
