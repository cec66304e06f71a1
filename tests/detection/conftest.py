"""How the tests of detection render their scenes."""

from __future__ import annotations

from functools import partial

import pytest

from rigkit.synthetic.render import Optics


@pytest.fixture(autouse=True)
def two_sub_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes whose blur alone is told are blurred by 0.6 px or more: two sub-samples along a pixel are enough."""
    monkeypatch.setattr("detection_bench.scenes.Optics", partial(Optics, supersample=2))
