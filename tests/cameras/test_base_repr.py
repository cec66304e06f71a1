"""repr of a camera: model, image size and every parameter by its name."""

from __future__ import annotations

import pytest
from helpers.cameras import sample_cameras

CAMERAS = sample_cameras()


@pytest.mark.parametrize("label", CAMERAS)
def test_repr_names_every_parameter(label: str) -> None:
    camera = CAMERAS[label]
    head, _, values = repr(camera).removesuffix(")").partition(": ")
    assert head == f"{type(camera).__name__}({camera.size_px[0]}x{camera.size_px[1]} px"
    printed = dict(value.split("=") for value in values.split(", "))
    assert tuple(printed) == camera.parameter_names()
    assert [float(value) for value in printed.values()] == pytest.approx(camera.parameters.tolist(), rel=1e-5)
