"""Figures for papers: vectors, the same file every time."""

from __future__ import annotations

import numpy as np
from helpers.reconstructions import make_reconstruction

from rigkit.report.figures import as_pdf, cloud_figure, corners_figure


def test_a_pdf_has_vectors_real_fonts_and_no_date() -> None:
    reconstruction = make_reconstruction()
    width, height = reconstruction.camera1.size_px
    image = np.full((height, width), 100, dtype=np.uint8)
    first, again = (as_pdf(corners_figure(reconstruction, image, image)) for _ in range(2))
    assert first == again
    assert first.startswith(b"%PDF")
    assert b"/Type3" not in first
    assert b"CreationDate" not in first
    # The cloud has no photograph in it: all of it is lines and text.
    assert b"/Subtype /Image" not in as_pdf(cloud_figure(reconstruction))
