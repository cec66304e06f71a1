"""What lenses may do beyond their models, in files of rigs: older files say nothing of it, damaged ones are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import InputError
from rigkit.io.calibrations.calibration_file import camera_to_json
from rigkit.io.calibrations.rig_file import load_saved_rig


@pytest.mark.parametrize(
    "damage",
    [
        {"modes": [[1.0]], "moves": [[1.0]]},
        {"modes": []},
        {"modes": [["x"]], "moves": []},
    ],
    ids=["few", "no moves", "a word"],
)
def test_departures_of_lenses_are_checked(damage: dict[str, object], tmp_path: Path) -> None:
    camera = camera_to_json(Pinhole((640, 480), np.array([600.0, 600.0, 319.5, 239.5])))
    rows = np.eye(4)[:3].tolist()
    cameras: list[dict[str, Any]] = [
        {"name": name, "camera": camera, "cam_from_rig": rows, "rms_px": 0.1} for name in ("left", "right")
    ]
    path = tmp_path / "rig.json"
    data = {"schema": "rigkit.rig/1", "sigma_px": 0.1, "covariance": np.eye(14).tolist(), "cameras": cameras}
    path.write_text(json.dumps(data))
    assert load_saved_rig(path).departures == ()
    for own in cameras:
        own["departures"] = {"modes": [], "moves": []}
    path.write_text(json.dumps(data))
    assert [own.modes.shape[1] for own in load_saved_rig(path).departures] == [0, 0]
    cameras[1]["departures"] = damage
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"rig\.json"):
        load_saved_rig(path)
