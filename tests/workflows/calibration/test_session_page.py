"""The page of a session with many images shows the worst of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.io.manifests.session import Session
from rigkit.workflows.calibration import session_page


def test_of_many_images_the_worst_are_shown(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    views, _, _ = random_views(lens("reg"), 8, rng, reach_deg=30.0, noise_px=0.1)
    wild = replace(views[5], pixels=views[5].pixels + 0.5 * rng.normal(size=views[5].pixels.shape))
    found = calibrate([*views[:5], wild, *views[6:]], SIZE, model="brown", board="flat", folds=0)
    found = replace(found, dropped=(("unread.png", "no board"),))
    paths = {name: Path(name) for name in (*(view.image for view in views), "unread.png")}
    session = Session(
        path=Path("session.toml"),
        images=tuple(paths.values()),
        boards=(BOARD,),
        model="brown",
        degree=None,
        board_shape="flat",
    )
    monkeypatch.setattr(session_page, "read_image", lambda _: np.zeros((31, 41), np.uint8))
    assert set(session_page._thumbnails(session, found)) == set(paths)
    monkeypatch.setattr(session_page, "MAX_PICTURES", 2)
    assert set(session_page._thumbnails(session, found)) == {wild.image, "unread.png"}
