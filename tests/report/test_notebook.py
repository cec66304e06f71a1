"""Results in a notebook: a verdict, a drawing that is valid XML, small output; a progress bar."""

from __future__ import annotations

import importlib
import re
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, lens, random_views
from helpers.reconstructions import make_reconstruction
from helpers.rig_scenes import rig_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.core.progress import silent
from rigkit.report.notebook import notebook_progress
from rigkit.workflows.calibration.calibrate import RigSessionCalibration, SessionCalibration

MAX_HTML = 60_000
"""A notebook keeps what it shows."""


def drawing(html: str) -> ElementTree.Element:
    found = re.search(r"<svg.*</svg>", html, re.DOTALL)
    assert found is not None
    return ElementTree.fromstring(found[0])


def test_a_reconstruction_shows_its_cloud_and_cameras() -> None:
    made = replace(make_reconstruction(), pair_id="<b>&")
    html = made._repr_html_()
    assert len(html) < MAX_HTML and "&lt;b&gt;&amp;" in html and f"{len(made.cloud)} points" in html
    dots = [e.get("d", "") for e in drawing(html).iter() if e.get("stroke-linecap") == "round"]
    assert sum(path.count("M") for path in dots) == len(made.cloud)


def test_a_calibration_and_a_rig_show_their_boards_and_the_verdict(rng: np.random.Generator) -> None:
    camera = lens("reg")
    alone = calibrate(random_views(camera, 8, rng, reach_deg=25.0)[0], camera.size_px, model="brown", board="flat")
    assert BOARD.board_id in {view.board_id for view in alone.views}
    views = {name: own for name, own in rig_views(rng, 8).items() if name != "fish"}
    sizes = {name: lens(name).size_px for name in views}
    rig = calibrate_rig(views, sizes, model={"reg": "brown", "wide": "kannala_brandt"})
    for result, cameras in ((alone, 1), (rig, 2)):
        html = result._repr_html_()
        assert len(html) < MAX_HTML and "held-out RMS" in html
        assert str(result.verdicts[0])[:20] in html
        assert sum(e.tag.endswith("text") for e in drawing(html).iter()) == cameras
    assert "Baseline reg to wide: " in rig._repr_html_()
    kept: dict[str, Any] = {"session": None, "unreadable": {}, "written": ()}
    session = SessionCalibration(calibration=alone, **kept)
    assert session._repr_html_() == alone._repr_html_()
    of_rig = RigSessionCalibration(rig=rig, checks=(), **kept)
    assert of_rig._repr_html_() == rig._repr_html_()


def test_progress_is_silent_without_a_notebook_and_a_bar_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert notebook_progress() is silent
    ipython = pytest.importorskip("IPython")
    found_words: list[str] = []

    class Handle:
        def update(self, shown: object) -> None:
            found_words.append(str(getattr(shown, "data", "")))

    def display(shown: object, display_id: bool) -> Handle:
        Handle().update(shown)
        return Handle()

    monkeypatch.setattr(ipython, "get_ipython", object)
    monkeypatch.setattr(importlib.import_module("IPython.display"), "display", display)
    show = notebook_progress()
    for done in range(4):
        show("corners <1>", done, 3)
    assert 'value="0" max="3"' in found_words[0] and 'value="3" max="3"' in found_words[-1]
    assert "corners &lt;1&gt;" in found_words[0]
