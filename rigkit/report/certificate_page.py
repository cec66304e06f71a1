"""A certificate in words, as a table, as one HTML page and as one sheet of A4."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rigkit.core.findings import Severity
from rigkit.core.tables import Table, cells, columns
from rigkit.report.certificate_figure import bound_figure, sheet_pdf
from rigkit.report.facts_page import build_facts_page
from rigkit.report.figures import as_png
from rigkit.report.page_facts import PageFacts
from rigkit.validation.certificate.contracts import Certificate, Quantity

WHAT = {
    Quantity.LENGTH: "A length of {size} mm across the line of sight",
    Quantity.DEPTH: "A depth of {size} mm along the line of sight",
    Quantity.PLANE: "A plane of {size} mm x {size} mm that faces the camera",
    Quantity.ANGLE: "A right angle between edges of {size} mm",
}


@dataclass(frozen=True, slots=True)
class CertificateWords:
    """What is stated: the headline, then sentences; `passed` against the limit, None where none was given."""

    headline: str
    sentences: tuple[str, ...]
    passed: bool | None


def in_words(certificate: Certificate, limit: float | None = None) -> CertificateWords:
    """Return what a certificate states, against `limit` (in the task's unit) where one is given."""
    task, unit = certificate.task, certificate.task.unit
    what = WHAT[task.quantity].format(size=f"{task.size_mm:g}") + f", {task.distance_mm:g} mm away"
    percent = f"{100.0 * task.confidence:g} %"
    headline = f"{what}: {percent} of errors within {certificate.worst:.3g} {unit} everywhere in view"
    sentences = [
        f"Half of the view keeps {certificate.median:.3g} {unit}; it is worst at pixel "
        f"({', '.join(f'{x:.0f}' for x in certificate.pixels[certificate.worst_place])}).",
        f"{100.0 * float(certificate.in_view.mean()):.0f} % of the image of camera '{certificate.instrument.names[0]}' "
        f"see all of it" + (" in both cameras." if certificate.instrument.is_rig else "."),
    ]
    passed = None
    if limit is not None:
        passed = certificate.worst <= limit
        share = certificate.share_within(limit)
        sentences.insert(0, f"The limit of {limit:g} {unit} is kept in {100.0 * share:.0f} % of the view.")
    sentences += [finding.text[0].upper() + finding.text[1:] + "." for finding in certificate.findings]
    return CertificateWords(headline, tuple(sentences), passed)


def causes_table(certificate: Certificate) -> Table:
    """Return what each cause contributes, one standard deviation, and its part of the variance where it is worst."""
    unit, shares = certificate.task.unit, certificate.shares()
    row, column = certificate.worst_place
    rows = tuple(
        cells(cause, float(np.nanmedian(sigma)), float(sigma[row, column]), 100.0 * shares[cause])
        for cause, sigma in certificate.sigma.items()
    )
    heads = columns(
        f"cause | median sigma [{unit}] .4 | sigma where worst [{unit}] .4 | part of the variance there [%] .1"
    )
    return Table("causes", "What the error is made of", heads, rows)


def certificate_facts(certificate: Certificate, limit: float | None = None) -> PageFacts:
    """Return what the certificate's page says."""
    words = in_words(certificate, limit)
    return PageFacts(
        headline=words.headline,
        badge={None: "no limit given", True: "within the limit", False: "beyond the limit"}[words.passed],
        passed=words.passed,
        sentences=words.sentences,
        tables=(causes_table(certificate),),
    )


def certificate_page(
    certificate: Certificate, title: str, provenance: Mapping[str, str], limit: float | None = None
) -> str:
    """Return the certificate as an HTML page that needs no other file."""
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
    words = in_words(certificate, limit)
    verdict = {None: "", True: "WITHIN THE LIMIT. ", False: "BEYOND THE LIMIT. "}[words.passed]
    facts = [f"{name}: {fact}" for name, fact in {**basis(certificate), **provenance}.items()]
    return sheet_pdf(certificate, title, [f"{verdict}{words.headline}.", *words.sentences], facts)


def basis(certificate: Certificate) -> dict[str, str]:
    """Return what the certificate rests on, in words."""
    i = certificate.instrument
    cameras = "; ".join(
        f"'{name}', {camera.model}, {camera.size_px[0]}x{camera.size_px[1]} px"
        for name, camera in zip(i.names, i.cameras, strict=True)
    )
    facts = {"cameras": cameras, "corners": f"standard deviation {i.sigma_px:.3g} px per coordinate"}
    if i.is_rig:
        a, b = (pose.inverse().translation_mm for pose in i.cam_from_rig)
        facts["baseline"] = f"{float(np.linalg.norm(b - a)):.2f} mm"
        facts["board scale"] = (
            f"{100.0 * i.scale_sigma:.3g} %" if i.scale_sigma else "counted as exact: nobody stated it"
        )
    percent = f"{100.0 * certificate.task.confidence:g} %"
    freedom = f", {i.freedom:.3g} degrees of freedom of the calibration" if np.isfinite(i.freedom) else ""
    facts["bound"] = f"{percent}, Student's quantile of the root of the summed variances{freedom}; to first order"
    remarks = [f.text for f in certificate.findings if f.severity is not Severity.GOOD]
    return facts | ({"remarks": "; ".join(remarks)} if remarks else {})
