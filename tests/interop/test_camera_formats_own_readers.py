"""Our camera files read by the other programs' own code, where it is installed."""

from __future__ import annotations

import importlib
from types import ModuleType

import pytest
from helpers.data import REPOSITORY

MODELS = {
    "ros": ("pinhole", "brown", "kannala_brandt"),
    "mrcal": ("pinhole", "brown"),
}
"""That the format has: nothing is refitted."""


@pytest.fixture(scope="module")
def scripts() -> ModuleType:
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(str(REPOSITORY / "scripts"))
        return importlib.import_module("round_trips")


@pytest.mark.parametrize(("program", "model"), [(name, model) for name, models in MODELS.items() for model in models])
def test_their_reader_has_the_same_camera(scripts: ModuleType, program: str, model: str) -> None:
    off_px = getattr(scripts, f"by_{program}")(scripts.lens_as(model))
    if off_px is None:
        pytest.skip(f"{program}'s own reader is not installed; scripts/calibrators/own_readers.py says what to install")
    assert off_px < scripts.EXACT_PX


def test_image_geometry_sees_a_stereo_pair_as_we_do(scripts: ModuleType) -> None:
    found = scripts.stereo_by_ros()
    if found is None:
        pytest.skip("ROS's own code is not installed (Debian: python3-image-geometry)")
    off_px, apart_mm = found
    assert off_px < scripts.EXACT_PX
    assert apart_mm < 1e-6
