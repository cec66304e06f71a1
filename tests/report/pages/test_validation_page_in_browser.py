"""The report in a real browser: no error in the console, nothing from the network, and a 3D view that turns."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from helpers.browser import MIN_FONT_PX, WIDTHS, probed_at_widths
from helpers.reconstructions import make_reconstruction

from rigkit.core.truth import MeasuredAngle, PairTruth
from rigkit.report.pages.validation_page import build_page, pair_section, summary_table
from rigkit.report.pages.validation_verdict import verdict_of
from rigkit.report.pictures.figures import as_png, cloud_figure
from rigkit.validation.checks import validate

PROBE = """<script>
const canvas = document.querySelector("canvas[data-scene]");
const before = canvas.dataset.view;
const {width, height} = canvas, {data} = canvas.getContext("2d").getImageData(0, 0, width, height);
const painted = data.some((v) => v > 0);
const outermost = (x, y) => x === 0 || y === 0 || x === width - 1 || y === height - 1;
const cut = data.some((v, i) => v > 0 && outermost((i >> 2) % width, Math.floor((i >> 2) / width)));
const at = (type, x) => canvas.dispatchEvent(
  new PointerEvent(type, {clientX: x, clientY: 100, pointerId: 1, bubbles: true, isPrimary: true}));
canvas.setPointerCapture = () => {};
at("pointerdown", 100); at("pointermove", 160); at("pointerup", 160);
const fits = document.body.scrollWidth <= innerWidth;
document.body.dataset.probe = [before, canvas.dataset.view, painted, cut, fits].join("|");
</script></body>"""


def test_the_page_works_without_network_and_fits_a_phone_a_tablet_and_a_screen(tmp_path: Path) -> None:
    reconstruction = make_reconstruction()
    truth = PairTruth(angles=(MeasuredAngle("plane1", "plane2", 90.0, 0.3, "set <square>"),))
    report = validate(reconstruction, truth)
    picture = ("The cloud", "image/png", as_png(cloud_figure(reconstruction)))
    section = pair_section(reconstruction, [report], [picture])
    page = build_page(
        "A & B", "lead", verdict_of([report], [report]), [summary_table([report])], [section], {"rigkit": "x" * 200}
    )
    assert not re.search(r"""(src|href)=["']?https?:""", page)
    assert "set &lt;square&gt;" in page
    at_widths, (before, after, painted, cut, fits) = probed_at_widths(page.replace("</body>", PROBE), tmp_path)
    assert len(at_widths) == len(WIDTHS)
    for width, (wide, small) in at_widths.items():
        assert wide <= width
        assert small >= MIN_FONT_PX
    assert painted == "true" and cut == "false"
    assert fits == "true"
    first, second = (np.array([float(v) for v in text.split()]) for text in (before, after))
    assert abs(first[0] - second[0]) > 0.1
