"""The certificate as pictures: the bound over the image with its contours, what it is made of, and a sheet of A4."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rigkit.report.figures import DPI, as_pdf, new_figure
from rigkit.validation.certificate.contracts import Certificate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

A4_INCHES = (8.27, 11.69)
LEVELS = 8
"""Contours of the bound."""
COVERED = 98.0
"""The colours end at this percentile: at the rim of the field the bound grows without end."""
LINE_CHARACTERS = 98


def bound_figure(certificate: Certificate) -> Figure:
    """Draw the bound over the image of the first camera, and the causes in the middle and where it is worst."""
    figure = new_figure(8, 4.2, dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 1.15))
    _draw_map(left, certificate)
    _draw_causes(right, certificate)
    return figure


def sheet_pdf(certificate: Certificate, title: str, statements: Sequence[str], facts: Sequence[str]) -> bytes:
    """Return one page of A4: what is stated, the map and the causes, what it rests on, and room for a signature."""
    figure = new_figure(*A4_INCHES)
    figure.text(0.09, 0.945, title, fontsize=15, weight="bold", va="top")
    top = _write(figure, 0.905, statements, size=9.5)
    map_height = 0.34
    left = figure.add_axes((0.11, top - map_height - 0.03, 0.52, map_height))
    right = figure.add_axes((0.76, top - map_height - 0.01, 0.15, map_height - 0.04))
    _draw_map(left, certificate)
    _draw_causes(right, certificate)
    _write(figure, top - map_height - 0.09, facts, size=8)
    for x, words in ((0.09, "Date"), (0.32, "Name"), (0.62, "Signature")):
        figure.text(x, 0.052, words, fontsize=8, color="0.35")
    for x, width in ((0.09, 0.19), (0.32, 0.26), (0.62, 0.29)):
        figure.add_artist(_rule(x, 0.068, width))
    return as_pdf(figure)


def _draw_map(axis: Any, certificate: Certificate) -> None:
    u, v = certificate.pixels[..., 0], certificate.pixels[..., 1]
    bound = np.ma.masked_invalid(certificate.bound)
    top = float(np.nanpercentile(certificate.bound, COVERED))
    mesh = axis.pcolormesh(u, v, bound, shading="nearest", cmap="viridis", vmin=0.0, vmax=top)
    if bound.min() < top:
        levels = np.linspace(0.0, top, LEVELS + 1)[1:]
        lines = axis.contour(u, v, bound, levels=levels, colors="white", linewidths=0.7)
        axis.clabel(lines, fontsize=7, fmt="%.3g")
    if certificate.coarse.any():
        rough = np.ma.masked_where(~certificate.coarse, np.ones(u.shape))
        axis.contourf(u, v, rough, levels=[0.5, 1.5], colors="none", hatches=["////"])
    width, height = certificate.instrument.cameras[0].size_px
    axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axis.tick_params(labelsize=7)
    task, name = certificate.task, certificate.instrument.names[0]
    axis.set_title(f"{100.0 * task.confidence:g} % of errors within, {task.unit}; image of camera '{name}'", fontsize=8)
    axis.figure.colorbar(mesh, ax=axis, shrink=0.8, extend="max").ax.tick_params(labelsize=7)


def _draw_causes(axis: Any, certificate: Certificate) -> None:
    row, column = certificate.worst_place
    middle = {cause: float(np.nanmedian(sigma)) ** 2 for cause, sigma in certificate.sigma.items()}
    worst = {cause: float(sigma[row, column]) ** 2 for cause, sigma in certificate.sigma.items()}
    for place, shares in enumerate((middle, worst)):
        whole, base = sum(shares.values()), 0.0
        for index, (cause, value) in enumerate(shares.items()):
            part = 100.0 * value / whole
            axis.bar(place, part, 0.7, bottom=base, color=f"C{index}", label=cause if place == 0 else None)
            base += part
    axis.set_xticks([0, 1], ["median", "worst"], fontsize=7)
    axis.set_ylabel("part of the variance, %", fontsize=7)
    axis.tick_params(labelsize=7)
    axis.legend(fontsize=7, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def _write(figure: Figure, top: float, paragraphs: Sequence[str], *, size: float) -> float:
    """Write paragraphs from `top` downwards; return where they end."""
    step = size * 1.45 / (72.0 * A4_INCHES[1])
    for paragraph in paragraphs:
        for line in textwrap.wrap(paragraph, int(LINE_CHARACTERS * 9.5 / size)):
            figure.text(0.09, top, line, fontsize=size, va="top")
            top -= step
        top -= 0.4 * step
    return top


def _rule(x: float, y: float, width: float) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([x, x + width], [y, y], color="0.35", linewidth=0.7)
