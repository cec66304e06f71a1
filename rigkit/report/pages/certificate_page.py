"""A certificate as facts, table, HTML page, and A4 sheet."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rigkit.calibration.certainty.displaced import lens_of
from rigkit.core.findings import Finding, Severity
from rigkit.core.measurement_task import Quantity
from rigkit.core.tables import Table, cells, columns
from rigkit.report.pages.page_facts import PageFacts, build_facts_page
from rigkit.report.pictures.figures import DPI, as_pdf, as_png, new_figure
from rigkit.validation.certificate.result import Certificate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WHAT = {
    Quantity.LENGTH: "A length of {size} mm across the line of sight",
    Quantity.DEPTH: "A depth of {size} mm along the line of sight",
    Quantity.PLANE: "A plane of {size} mm x {size} mm that faces the camera",
    Quantity.ANGLE: "A right angle between edges of {size} mm",
}
A4_INCHES = (8.27, 11.69)
LEGEND_LINE = 0.038
"""Height of a line of the legend, relative to that of the figure on a page."""
LEVELS = 8
"""Number of contours of the bound."""
COVERED = 98.0
"""Percentile at which the colours end: at the border of the field the bound is unlimited."""
LINE_CHARACTERS = 98
"""Width of a line of words of WORDS_SIZE on the sheet."""
WORDS_SIZE, FACT_SIZE = 9.5, 8.0
"""Sizes of the statements and of the basis on the sheet, points."""
PARAGRAPH_GAP = 0.4
"""Gap after a paragraph, lines."""
MAP_HEIGHT, SIGNATURE_TOP = 0.34, 0.075
"""Heights on the sheet, relative to it: of the map where the words leave room, and of the lines for the signature."""


def certificate_facts(certificate: Certificate, limit: float | None = None) -> PageFacts:
    """Return the facts of a certificate, compared with `limit` (in the task's unit) if given."""
    unit = certificate.task.unit
    place = ", ".join(f"{x:.0f}" for x in certificate.pixels[certificate.worst_place])
    view = "that part" if certificate.coarse_share else "the view"
    sentences = [
        f"The bound is within {certificate.median:.3g} {unit} in half of {view}, and largest at pixel ({place}).",
        f"{100.0 * float(certificate.in_view.mean()):.0f} % of the image of camera '{certificate.instrument.names[0]}' "
        "has the whole object in view" + (" of both cameras." if certificate.instrument.is_rig else "."),
    ]
    if certificate.coarse_share == 1.0:
        del sentences[0]
    elif limit is not None:
        share = _percent(certificate.share_within(limit))
        sentences.insert(0, f"The bound is within the limit of {limit:g} {unit} in {share} of the view.")
    bad = [finding for finding in certificate.findings if finding.severity is Severity.BAD]
    others = [finding for finding in certificate.findings if finding.severity is not Severity.BAD]
    return PageFacts(
        headline=_headline(certificate),
        badge=_badge(certificate, limit),
        passed=certificate.passes(limit),
        sentences=(*map(_sentence, bad), *sentences, *map(_sentence, others)),
        tables=(causes_table(certificate),),
    )


def _headline(certificate: Certificate) -> str:
    task, coarse = certificate.task, certificate.coarse_share
    what = WHAT[task.quantity].format(size=f"{task.size_mm:g}") + f", {task.distance_mm:g} mm away"
    if coarse == 1.0:
        return f"{what}: no bound is certified"
    where = f"in {_percent(1.0 - coarse)} of the view; elsewhere none is certified"
    return (
        f"{what}: {100.0 * task.confidence:g} % of errors within {certificate.worst:.3g} {task.unit} "
        f"{where if coarse else 'everywhere in view'}"
    )


def _badge(certificate: Certificate, limit: float | None) -> str:
    if certificate.coarse_share < 1.0 and certificate.is_bad:
        return "not to be trusted"
    if certificate.is_bad or (limit is not None and not certificate.passes(limit) and certificate.worst <= limit):
        return "not certified"
    return {None: "no limit given", True: "within the limit", False: "above the limit"}[certificate.passes(limit)]


def _percent(share: float) -> str:
    """Return a share in words that are 0 or 100 % of nothing or all alone."""
    return f"{100.0 * share:.0f} %" if share in (0.0, 1.0) else f"{min(max(100.0 * share, 1.0), 99.0):.0f} %"


def _sentence(finding: Finding) -> str:
    return finding.text[0].upper() + finding.text[1:] + "."


def causes_table(certificate: Certificate) -> Table:
    """Return the standard deviation from each cause that is not treated as exact, and its part of the variance at the
    worst place."""
    unit, shares = certificate.task.unit, certificate.shares()
    row, column = certificate.worst_place
    rows = tuple(
        cells(cause, float(np.median(sigma[certificate.places])), float(sigma[row, column]), 100.0 * shares[cause])
        for cause, sigma in certificate.sigma.items()
        if np.any(sigma[certificate.places] > 0.0)
    )
    heads = columns(
        f"cause | median sigma [{unit}] .4 | sigma where worst [{unit}] .4 | share of the variance there [%] .1"
    )
    return Table("causes", "Error budget", heads, rows)


def certificate_page(
    certificate: Certificate, title: str, provenance: Mapping[str, str], limit: float | None = None
) -> str:
    """Return the certificate as self-contained HTML."""
    return build_facts_page(
        title,
        certificate_facts(certificate, limit),
        {**basis(certificate), **provenance},
        pictures=[("The bound over the image and its causes", lambda: as_png(bound_figure(certificate)))],
        signed=True,
    )


def certificate_pdf(
    certificate: Certificate, title: str, provenance: Mapping[str, str], limit: float | None = None
) -> bytes:
    """Return the certificate as one sheet of A4 with room for a signature."""
    page = certificate_facts(certificate, limit)
    verdict = "" if page.passed is None else f"{page.badge.upper()}. "
    facts = [f"{name}: {fact}" for name, fact in {**basis(certificate), **provenance}.items()]
    figure = new_figure(*A4_INCHES)
    figure.text(0.09, 0.945, title, fontsize=15, weight="bold", va="top")
    top = _write(figure, 0.905, [f"{verdict}{page.headline}.", *page.sentences], size=WORDS_SIZE)
    lines = sum(len(_lines(fact, FACT_SIZE)) + PARAGRAPH_GAP for fact in facts)
    map_height = min(MAP_HEIGHT, top - 0.09 - lines * _line_height(FACT_SIZE) - SIGNATURE_TOP)
    left = figure.add_axes((0.11, top - map_height - 0.03, 0.52, map_height))
    right = figure.add_axes((0.76, top - map_height - 0.01, 0.15, map_height - 0.04))
    _draw_map(left, certificate)
    _draw_causes(right, certificate)
    _write(figure, top - map_height - 0.09, facts, size=FACT_SIZE)
    for x, words in ((0.09, "Date"), (0.32, "Name"), (0.62, "Signature")):
        figure.text(x, 0.052, words, fontsize=8, color="0.35")
    for x, width in ((0.09, 0.19), (0.32, 0.26), (0.62, 0.29)):
        figure.add_artist(_rule(x, 0.068, width))
    return as_pdf(figure)


def basis(certificate: Certificate) -> dict[str, str]:
    """Return the basis of the certificate: cameras, corners, baseline and statistics, in words."""
    i = certificate.instrument
    cameras = "; ".join(
        f"'{name}', {lens_of(camera).model}, {camera.size_px[0]}x{camera.size_px[1]} px"
        for name, camera in zip(i.names, i.cameras, strict=True)
    )
    facts = {"cameras": cameras, "corners": f"standard deviation {i.sigma_px:.3g} px per coordinate"}
    if i.is_rig:
        a, b = (pose.inverse().translation_mm for pose in i.cam_from_rig)
        facts["baseline"] = f"{float(np.linalg.norm(b - a)):.2f} mm"
        facts["board scale"] = f"{100.0 * i.scale_sigma:.3g} %" if i.scale_sigma else "not stated: treated as exact"
    percent = f"{100.0 * certificate.task.confidence:g} %"
    freedom = f", {i.freedom:.3g} degrees of freedom of the calibration" if np.isfinite(i.freedom) else ""
    facts["bound"] = f"{percent}, by Student's distribution from the summed variances{freedom}; to first order"
    return facts


def bound_figure(certificate: Certificate) -> Figure:
    """Draw the bound over the image of the first camera, and the causes at the median and the worst place."""
    # Placed by hand: matplotlib takes a third of the drawing's time to find a layout.
    figure = new_figure(8, 4.2, dpi=DPI)
    left = figure.add_axes((0.06, 0.08, 0.64, 0.84))
    right = figure.add_axes((0.77, 0.08, 0.22, 0.88 - LEGEND_LINE * len(certificate.sigma)))
    _draw_map(left, certificate)
    _draw_causes(right, certificate)
    return figure


def _draw_map(axis: Any, certificate: Certificate) -> None:
    u, v = certificate.pixels[..., 0], certificate.pixels[..., 1]
    bound = np.ma.masked_invalid(certificate.bound)
    top = float(np.nanpercentile(certificate.bound, COVERED))
    mesh = axis.pcolormesh(u, v, bound, shading="nearest", cmap="viridis", vmin=0.0, vmax=top)
    bar = axis.figure.colorbar(mesh, ax=axis, shrink=0.8, extend="max")
    bar.ax.tick_params(labelsize=7)
    if bound.min() < top:
        levels = np.linspace(0.0, top, LEVELS + 1)[1:]
        contours = axis.contour(u, v, bound, levels=levels, colors="white", linewidths=0.7)
        bar.add_lines(contours)
    if certificate.coarse.any():
        rough = np.ma.masked_where(~certificate.coarse, np.ones(u.shape))
        axis.contourf(u, v, rough, levels=[0.5, 1.5], colors="none", hatches=["////"])
    width, height = certificate.instrument.cameras[0].size_px
    axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axis.tick_params(labelsize=7)
    task, name = certificate.task, certificate.instrument.names[0]
    axis.set_title(f"{100.0 * task.confidence:g} % of errors within, {task.unit}; image of camera '{name}'", fontsize=8)


def _draw_causes(axis: Any, certificate: Certificate) -> None:
    row, column = certificate.worst_place
    middle = {cause: float(np.median(sigma[certificate.places])) ** 2 for cause, sigma in certificate.sigma.items()}
    worst = {cause: float(sigma[row, column]) ** 2 for cause, sigma in certificate.sigma.items()}
    for place, shares in enumerate((middle, worst)):
        whole, base = sum(shares.values()), 0.0
        for index, (cause, value) in enumerate(shares.items()):
            part = 100.0 * value / whole
            axis.bar(place, part, 0.7, bottom=base, color=f"C{index}", label=cause if place == 0 else None)
            base += part
    axis.set_xticks([0, 1], ["median", "worst"], fontsize=7)
    axis.set_ylim(0.0, 100.0)
    axis.set_ylabel("share of the variance, %", fontsize=7)
    axis.tick_params(labelsize=7)
    axis.legend(fontsize=7, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def _write(figure: Figure, top: float, paragraphs: Sequence[str], *, size: float) -> float:
    """Write paragraphs downwards from `top`; return the position of their end."""
    step = _line_height(size)
    for paragraph in paragraphs:
        for line in _lines(paragraph, size):
            figure.text(0.09, top, line, fontsize=size, va="top")
            top -= step
        top -= PARAGRAPH_GAP * step
    return top


def _lines(paragraph: str, size: float) -> list[str]:
    return textwrap.wrap(paragraph, int(LINE_CHARACTERS * WORDS_SIZE / size))


def _line_height(size: float) -> float:
    """Return the distance of lines of words of `size` (points), relative to the height of the sheet."""
    return size * 1.45 / (72.0 * A4_INCHES[1])


def _rule(x: float, y: float, width: float) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([x, x + width], [y, y], color="0.35", linewidth=0.7)
