"""From a calibration file to a certificate of the lengths that can be measured with it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.measurement_task import Task
from rigkit.core.printing import brief
from rigkit.io.calibrations.rig_file import is_rig_file, load_saved_rig
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, write_together
from rigkit.report.pages.certificate_page import certificate_facts, certificate_page, certificate_pdf
from rigkit.report.pages.page_facts import PageFacts
from rigkit.validation.certificate.certify import certify
from rigkit.validation.certificate.result import Certificate, instrument_of
from rigkit.validation.monitoring.evidence import Monitored
from rigkit.workflows.checks.check import load_monitored
from rigkit.workflows.inputs.camera_files import bad_verdict_in_file
from rigkit.workflows.options.cameras import CertifyOptions
from rigkit.workflows.outputs.provenance import digest_line, software_facts


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CertifiedFile:
    """The certificate: the bound over the image, the contents of its page, and the files that were written."""

    certificate: Certificate
    words: PageFacts
    written: tuple[Path, ...]

    __repr__ = brief


def certify_file(path: str | Path, task: Task, options: CertifyOptions | None = None) -> CertifiedFile:
    """Certify the errors of measuring `task` with a calibration or a rig, and write the files in `options`.

    Raises InputError for a file that is no calibration or has no covariance, for an unknown camera, or a file that
    cannot be written; DegenerateError where no point of `task` is in the fields of view of all cameras.
    """
    options = options or CertifyOptions()
    ensure_writable((options.report, options.pdf), force=options.force, inputs=[path])
    if options.limit is not None and not (np.isfinite(options.limit) and options.limit > 0.0):
        raise InputError(f"certificate: the limit must be positive, got {options.limit}")
    with about(path):
        certificate = certify(load_instrument(path, options.cameras, options.sigma_px), task)
    if (bad := bad_verdict_in_file(path)) is not None:
        certificate = replace(certificate, findings=(bad, *certificate.findings))
    if any(isinstance(camera, NearCamera) for camera in certificate.instrument.cameras):
        message = Finding.good("the lens is not central: its moving entrance pupil is included")
        certificate = replace(certificate, findings=(*certificate.findings, message))
    certificate = replace(
        certificate, findings=(*certificate.findings, *_not_at_once(path, certificate.instrument.names))
    )
    title = f"Certificate: {task.quantity} with {Path(path).name}"
    facts = {Path(path).name: digest_line(Path(path)), **software_facts()}
    files: dict[Path, str | bytes] = {}
    if options.report is not None:
        files[options.report] = certificate_page(certificate, title, facts, options.limit)
    if options.pdf is not None:
        files[options.pdf] = certificate_pdf(certificate, title, facts, options.limit)
    write_together(files, force=options.force)
    words = certificate_facts(certificate, options.limit)
    return CertifiedFile(certificate=certificate, words=words, written=tuple(files))


def _not_at_once(path: str | Path, names: Sequence[str]) -> Iterator[Finding]:
    """Yield a finding where the cameras of a rig do not expose at one instant."""
    lags = load_saved_rig(path).lags if is_rig_file(path) else {}
    if any(name in lags for name in names):
        first, last = sorted(names, key=lambda name: lags[name].frames if name in lags else 0.0)
        apart = sum(sign * lags[name].frames for name, sign in ((first, -1.0), (last, 1.0)) if name in lags)
        jitter = math.hypot(*(lags[name].scatter for name in names if name in lags))
        yield Finding.look(
            f"camera '{last}' exposes {apart:.3f} frame periods after '{first}' (jitter {jitter:.3f}): the bound is of "
            "things at rest",
            "measure nothing that moves, or trigger the cameras together",
        )


def load_instrument(
    path: str | Path, cameras: tuple[str, str] | None = None, sigma_px: float | None = None
) -> Monitored:
    """Return the camera of a calibration file, for points in mm, or two cameras of a rig's, with their covariance.

    Raises InputError for another file, or one without a covariance.
    """
    rig = is_rig_file(path)
    if cameras is not None and not rig:
        raise InputError(f"'{path}': --names gives two cameras of a rig, and this is not a rig's file")
    known, _ = load_monitored(Path(path))
    if rig and len(known.names) < 2:
        raise InputError(f"'{path}': a rig of one camera; give that camera's calibration")
    return instrument_of(replace(known, sigma_px=sigma_px or known.sigma_px), cameras)
