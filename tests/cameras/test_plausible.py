"""Parameters that no lens can have."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.cameras.plausible import fault_of_lens
from rigkit.cameras.registry import camera_model

LENSES = {
    "pinhole": (400.0, 400.0, 320.0, 240.0),
    "brown": (420.0, 421.0, 320.0, 240.0, -0.28, 0.07, 2e-4, 1.7e-5, 0.0),
    "kannala_brandt": (190.0, 190.0, 320.0, 240.0, 0.01, -0.005, 0.001, 0.0),
    "eucm": (190.0, 190.0, 320.0, 240.0, 0.6, 1.1),
    "double_sphere": (190.0, 190.0, 320.0, 240.0, -0.2, 0.6),
    "scaramuzza": (190.0, -1.2e-3, 4e-7, -1e-9, 320.0, 240.0, 1.0, 0.0),
}


@pytest.mark.parametrize("model", LENSES)
def test_plausible_lenses_are_accepted(model: str) -> None:
    assert fault_of_lens(camera_model(model)((640, 480), np.array(LENSES[model]))) is None


@pytest.mark.parametrize(
    ("model", "at", "value", "printed"),
    [
        ("pinhole", 0, 1e-3, "focal length"),
        ("pinhole", 0, 1e9, "focal length"),
        ("pinhole", 0, -400.0, "turn the axes"),
        ("pinhole", 2, 1e9, "axis"),
        ("brown", 6, 1e12, "sees nothing"),
        ("kannala_brandt", 4, -1e12, "sees nothing"),
        ("scaramuzza", 0, 1e-160, "focal length"),
        ("scaramuzza", 1, 1e9, "sees nothing"),
        ("double_sphere", 1, 1e-9, "focal length"),
    ],
)
def test_implausible_lenses_are_refused(model: str, at: int, value: float, printed: str) -> None:
    parameters = np.array(LENSES[model])
    parameters[at] = value
    assert printed in str(fault_of_lens(camera_model(model)((640, 480), parameters)))
