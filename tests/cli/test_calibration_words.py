"""Images that are left out are said by reason: of a video hundreds may show no board."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from rigkit.cli.calibration_words import left_out


def test_a_reason_is_said_once_with_its_first_images() -> None:
    nothing = [(f"f{k:03d}.png", "no board found") for k in range(200)]
    dropped = [("one.png", "is damaged"), *nothing, ("used.png", "board 'b' lies beside"), ("two.png", "is damaged")]
    calibration: Any = SimpleNamespace(views=[SimpleNamespace(image="used.png")], dropped=dropped)
    assert left_out(calibration) == [
        "dropped one.png, two.png: is damaged",
        "dropped f000.png, f001.png, f002.png and 197 more: no board found",
        "left out of used.png: board 'b' lies beside",
    ]
