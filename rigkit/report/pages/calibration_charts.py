"""Charts of a calibration as SVG: error by image and by radius, histogram of residuals, curve of the lens."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import takewhile
from pathlib import Path
from typing import TypeVar

import numpy as np

from rigkit.calibration.certainty.uncertainty import projection_uncertainty
from rigkit.calibration.result import Calibration
from rigkit.core.arrays import FloatArray, sampling_step
from rigkit.optim.robust_scale import robust_sigma
from rigkit.report import svg
from rigkit.report.svg import DRAWN_WIDTH, INK, SOFT, round_down, round_up

WIDTH, HEIGHT = DRAWN_WIDTH, 330.0
LEFT, RIGHT, TOP, BOTTOM = 70.0, 24.0, 12.0, 46.0
LINES, FAINT_WORDS = "#c2410c", "#5b6575"
MAX_RESIDUAL_DOTS = 4000
BARS_NAMED = 24
"""Maximum number of images whose bars have names; more are numbered."""
MAX_NAME = 16
"""Longer names are truncated to their end."""
LEVEL_NAME = 3
"""Names of at most so many letters are horizontal, longer ones vertical."""
LETTER = 7.4
"""Maximum width of a letter."""
BINS = 41
IMAGE_RINGS = 12
"""Number of rings with equal numbers of corners, for the RMS by radius."""
CURVE_POINTS = 120
TICKS = (1.0, 2.0, 2.5, 5.0, 10.0)
HALF_STEPS = np.arange(1.0, 10.1, 0.5)


Value = TypeVar("Value", float, FloatArray)


class _Plot:
    """Axes that map data to the drawing."""

    def __init__(
        self,
        title: str,
        x: tuple[float, float],
        y: tuple[float, float],
        labels: tuple[str, str],
        bottom: float = BOTTOM,
    ) -> None:
        self._x, self._y, self.floor = x, y, HEIGHT - bottom
        self.parts = [svg.opening_tag(title, f"0 0 {WIDTH:g} {HEIGHT:g}")]
        for value in _ticks(*y):
            at = self.v(value)
            self.parts.append(f'<path d="M{LEFT} {at:.1f}H{WIDTH - RIGHT}" stroke="{svg.GRID_COLOUR}"/>')
            self.words(LEFT - 6, at + 4, f"{value:g}", "end")
        self.words(0.5 * (LEFT + WIDTH - RIGHT), HEIGHT - 6, labels[0], "middle")
        self.parts.append(
            f'<text transform="translate(13 {0.5 * (TOP + self.floor):.1f}) rotate(-90)" text-anchor="middle" '
            f'fill="{svg.WORDS_COLOUR}">{escape(labels[1])}</text>'
        )

    def u(self, x: Value) -> Value:
        return LEFT + (x - self._x[0]) / (self._x[1] - self._x[0]) * (WIDTH - LEFT - RIGHT)

    def v(self, y: Value) -> Value:
        return self.floor - (y - self._y[0]) / (self._y[1] - self._y[0]) * (self.floor - TOP)

    def words(self, x: float, y: float, text: str, anchor: str = "start", colour: str = svg.WORDS_COLOUR) -> None:
        self.parts.append(svg.label(x, y, text, anchor, colour))

    def below(self, values: Sequence[float]) -> None:
        for value in values:
            self.words(self.u(value), self.floor + 18, f"{value:g}", "middle")

    def line(self, x: FloatArray, y: FloatArray, colour: str, *, width: float = 1.8, dashes: str = "") -> None:
        places = " ".join(f"{self.u(float(a)):.1f},{self.v(float(b)):.1f}" for a, b in zip(x, y, strict=True))
        dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
        self.parts.append(f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="{width}"{dashed}/>')

    def done(self) -> str:
        frame = f'<path d="M{LEFT} {TOP}V{self.floor}H{WIDTH - RIGHT}" fill="none" stroke="{svg.RIM_COLOUR}"/></svg>'
        return "".join([*self.parts, frame])


def images_svg(calibration: Calibration) -> str:
    """Draw the RMS of every view as a bar, with the RMS of all as a line."""
    rms = np.array([view.rms_px for view in calibration.views])
    rms = np.where(np.isfinite(rms), rms, 0.0)
    top = round_up(max(1.1 * float(rms.max(initial=0.0)), 1e-6))
    names = _short_names([view.image for view in calibration.views]) if len(rms) <= BARS_NAMED else []
    longest = max(map(len, names), default=0)
    upright = longest > LEVEL_NAME
    bottom = LETTER * longest + 14.0 if upright else BOTTOM
    plot = _Plot("RMS by image", (-0.5, len(rms) - 0.5), (0.0, top), ("" if names else "view", "RMS, px"), bottom)
    wide = max(0.8 * (plot.u(1.0) - plot.u(0.0)), 0.8)
    for k, (view, value) in enumerate(zip(calibration.views, rms, strict=True)):
        x, y = plot.u(k) - 0.5 * wide, plot.v(float(value))
        what = escape(f"{view.image}, {view.board_id}: {value:.3f} px")
        plot.parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{plot.v(0.0) - y:.1f}" fill="{INK}">'
            f"<title>{what}</title></rect>"
        )
    for k, name in enumerate(names):
        place = f"translate({plot.u(k) + 4:.1f} {plot.floor + 6:.1f}) rotate(-90)"
        if not upright:
            place = f"translate({plot.u(k):.1f} {plot.floor + 18:.1f})"
        anchor = "end" if upright else "middle"
        plot.parts.append(
            f'<text transform="{place}" text-anchor="{anchor}" font-size="12.5" fill="{svg.WORDS_COLOUR}">'
            f"{escape(name)}</text>"
        )
    if not names:
        plot.below(_ticks(0.0, len(rms) - 1.0))
    plot.line(np.array([-0.5, len(rms) - 0.5]), np.full(2, calibration.rms_px), LINES, dashes="5 4")
    plot.words(WIDTH - RIGHT, TOP + 12, f"line: all, {calibration.rms_px:.3f} px", "end", LINES)
    return plot.done()


def _short_names(names: Sequence[str]) -> list[str]:
    """Return names without endings and without their common prefix (numbers are not split); long ones truncated."""
    stems = [Path(name).stem for name in names]
    if len(set(stems)) > 1:
        columns = zip(*stems, strict=False)
        same = sum(1 for _ in takewhile(lambda letters: len(set(letters)) == 1, columns))
        while same and stems[0][same - 1].isdigit():
            same -= 1
        stems = [stem[same:] for stem in stems]
    return [stem if len(stem) <= MAX_NAME else f"…{stem[1 - MAX_NAME :]}" for stem in stems]


def radius_svg(calibration: Calibration) -> str:
    """Draw the error of every corner over its distance from the image centre, and the RMS of rings: a lens that the
    model does not fit shows in the outer ones."""
    pixels, residuals = calibration.corners.used
    centre = 0.5 * (np.array(calibration.camera.size_px) - 1.0)
    radius, error = np.linalg.norm(pixels - centre, axis=1), np.linalg.norm(residuals, axis=1)
    top = round_up(float(np.quantile(error, 0.995)))
    reach = round_up(float(np.linalg.norm(centre)), HALF_STEPS)
    plot = _Plot(
        "error against radius", (0.0, reach), (0.0, top), ("distance from the image's centre, px", "error, px")
    )
    step = sampling_step(len(radius), MAX_RESIDUAL_DOTS)
    shown = error[::step] <= top
    places = np.stack([plot.u(radius[::step][shown]), plot.v(error[::step][shown])], axis=-1)
    plot.parts.append(
        f'<path d="{svg.dots(places)}" stroke="{INK}" stroke-opacity=".35" stroke-width="2.4" stroke-linecap="round"/>'
    )
    order = np.array_split(np.argsort(radius), min(IMAGE_RINGS, max(len(radius) // 20, 1)))
    rings = np.array([[radius[o].mean(), np.sqrt(np.mean(error[o] ** 2))] for o in order])
    plot.line(rings[:, 0], rings[:, 1], LINES, width=2.4)
    plot.words(WIDTH - RIGHT, TOP + 12, "line: RMS by ring", "end", LINES)
    plot.below(_ticks(0.0, reach))
    return plot.done()


def histogram_svg(calibration: Calibration) -> str:
    """Draw the histogram of residuals (u and v), with the normal distribution of their robust sigma."""
    _, residuals = calibration.corners.used
    values = residuals.reshape(-1)
    sigma = robust_sigma(values)
    reach = round_up(max(4.0 * sigma, 1e-6), HALF_STEPS)
    counts, edges = np.histogram(values, BINS, (-reach, reach))
    step = edges[1] - edges[0]
    x = np.linspace(-reach, reach, CURVE_POINTS)
    curve = len(values) * step / (sigma * np.sqrt(2.0 * np.pi)) * np.exp(-0.5 * (x / sigma) ** 2)
    top = round_up(float(max(counts.max(), curve.max())))
    plot = _Plot("residuals", (-reach, reach), (0.0, top), ("residual along u or v, px", "count"))
    for count, left in zip(counts, edges, strict=False):
        y, wide = plot.v(float(count)), plot.u(float(left + step)) - plot.u(float(left))
        place = f'x="{plot.u(float(left)):.1f}" y="{y:.1f}" width="{wide:.1f}" height="{plot.v(0.0) - y:.1f}"'
        plot.parts.append(f'<rect {place} fill="{INK}" fill-opacity=".6"/>')
    plot.line(x, curve, LINES)
    beyond = int((np.abs(values) > reach).sum())
    plot.words(WIDTH - RIGHT, TOP + 12, f"line: normal, sigma {sigma:.3g} px; {beyond} are outside", "end", LINES)
    plot.below([-reach, -0.5 * reach, 0.0, 0.5 * reach, reach])
    return plot.done()


def lens_svg(calibration: Calibration) -> str:
    """Draw the radius (px from the principal point, to the right) over the angle from the axis, and the perspective and
    the equidistant projection to compare; the band is the magnified uncertainty."""
    camera = calibration.camera
    edge = np.array([[camera.size_px[0] - 1.0, 0.5 * (camera.size_px[1] - 1.0)]])
    axis, _ = camera.project(np.array([[0.0, 0.0, 1.0]]))
    u = np.linspace(float(axis[0, 0]), float(edge[0, 0]), CURVE_POINTS)
    pixels = np.stack([u, np.full(CURVE_POINTS, float(axis[0, 1]))], axis=-1)
    rays, valid = camera.unproject(pixels)
    rays, pixels = rays[valid], pixels[valid]
    angle = np.degrees(np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2]))
    radius = np.linalg.norm(pixels - axis, axis=1)
    band = projection_uncertainty(calibration, pixels).worst_px
    focal = float(np.gradient(radius, np.radians(angle))[1])
    reach, top = round_up(float(angle.max()), HALF_STEPS), round_up(float(radius.max()), HALF_STEPS)
    plot = _Plot("the lens", (0.0, reach), (0.0, top), ("angle off the axis, deg", "distance from its centre, px"))
    theta = np.linspace(0.0, reach, CURVE_POINTS)
    for curve, dashes in (
        (focal * np.tan(np.radians(np.minimum(theta, 89.0))), "2 3"),
        (focal * np.radians(theta), "7 4"),
    ):
        inside = curve <= top
        plot.line(theta[inside], curve[inside], SOFT, width=1.2, dashes=dashes)
    plot.words(WIDTH - RIGHT, HEIGHT - BOTTOM - 34, "dotted: perspective", "end", FAINT_WORDS)
    plot.words(WIDTH - RIGHT, HEIGHT - BOTTOM - 10, "dashed: equidistant", "end", FAINT_WORDS)
    known = np.isfinite(band)
    times = round_down(0.1 * top / max(float(np.nanmedian(band)), 1e-9)) if known.any() else 1.0
    around = np.clip(np.nan_to_num(band) * times, 0.0, 0.5 * top)
    both = [*zip(angle, radius + around, strict=True), *zip(angle[::-1], (radius - around)[::-1], strict=True)]
    outline = " ".join(f"{plot.u(a):.1f},{plot.v(float(np.clip(r, 0.0, top))):.1f}" for a, r in both)
    plot.parts.append(f'<polygon points="{outline}" fill="{INK}" fill-opacity=".18"/>')
    plot.line(angle, radius, INK, width=2.2)
    plot.words(LEFT + 10, TOP + 12, f"band: one sigma, {times:g} times magnified", colour=INK)
    plot.below(_ticks(0.0, reach))
    return plot.done()


def _ticks(low: float, high: float) -> list[float]:
    """Return about five round values between `low` and `high`."""
    rough = max(high - low, 1e-12) / 5.0
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(m * power for m in TICKS if m * power >= rough)
    return [float(f"{k * step:.10g}") for k in range(int(np.ceil(low / step)), int(np.floor(high / step + 1e-9)) + 1)]
