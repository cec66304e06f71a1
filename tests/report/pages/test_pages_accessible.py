"""Accessibility of the pages: axe-core finds no fault, light and dark, on a phone and on a screen.

axe-core is not part of this repository: `npm install --no-save axe-core` puts it where this looks, or RIGKIT_AXE says
where axe.min.js is.
"""

from __future__ import annotations

import html
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import loaded
from helpers.calibration_scenes import lens
from helpers.data import REPOSITORY
from helpers.pages import page_of, reported
from helpers.rig_scenes import rig_views

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.tables import Cell, Column, Table
from rigkit.report.pages.calibration_charts import images_svg
from rigkit.report.pages.calibration_page import CalibrationSection, build_calibration_page
from rigkit.report.pages.page_facts import PageFacts, build_facts_page

SCHEMES = {"light": "--blink-settings=preferredColorScheme=1", "dark": "--blink-settings=preferredColorScheme=0"}
RUN = """<script>%s</script><script>
addEventListener("load", () => axe.run(document, {runOnly: ["wcag2a", "wcag2aa", "best-practice"]}).then((found) => {
  document.body.dataset.faults = JSON.stringify(found.violations.map((v) => [v.impact, v.id, v.nodes[0].html]));
  document.body.dataset.checked = found.passes.length;
  document.body.dataset.scheme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
}));
</script></body>"""
MIN_CHECKED = 15
"""Rules that apply to any of our pages: fewer, and it did not run."""


@pytest.fixture(scope="module")
def axe() -> str:
    places = [Path(os.environ.get("RIGKIT_AXE", "")), REPOSITORY / "node_modules" / "axe-core" / "axe.min.js"]
    found = [place for place in places if place.is_file()]
    if not found:
        pytest.skip("no axe-core (npm install --no-save axe-core, or RIGKIT_AXE=.../axe.min.js)")
    return found[0].read_text(encoding="utf-8")


def validation_page() -> str:
    return page_of(reported(88.0))


def two_cameras(**options: Any) -> RigCalibration:
    views = {name: own for name, own in rig_views(np.random.default_rng(3), 8).items() if name != "fish"}
    sizes = {name: lens(name).size_px for name in views}
    return calibrate_rig(views, sizes, model={"reg": "brown", "wide": "kannala_brandt"}, **options)


def rig_page() -> str:
    rig = two_cameras()
    sections = [CalibrationSection(c.name, c.calibration) for c in rig.cameras]
    return build_calibration_page("A rig", "lead", sections, {"rigkit": "x"}, rig)


def facts_page() -> str:
    rig = two_cameras(folds=0)
    table = Table("t", "A table", (Column("what"), Column("how much", "mm")), ((Cell("a length"), Cell(3.2)),))
    return build_facts_page(
        "Facts",
        PageFacts(
            headline="A length: 95 % of errors within 0.3 mm",
            badge="no limit given",
            sentences=("The bound is 0.2 mm in half of the view.",),
            tables=(table,),
        ),
        {"rigkit": "x"},
        links=[("one", "one/report.html")],
        drawings=[("by image", images_svg(rig.cameras[0].calibration))],
    )


@pytest.mark.parametrize("make", [validation_page, rig_page, facts_page])
def test_axe_finds_no_fault(axe: str, make: Callable[[], str], tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(make().replace("</body>", RUN % axe.replace("</script>", "<\\/script>")), encoding="utf-8")
    for scheme, setting in SCHEMES.items():
        found_words = dict(re.findall(r'data-(faults|checked|scheme)="([^"]*)"', loaded(page, setting, seconds=240.0)))
        assert found_words["scheme"] == scheme and int(found_words["checked"]) >= MIN_CHECKED
        assert json.loads(html.unescape(found_words["faults"])) == []
