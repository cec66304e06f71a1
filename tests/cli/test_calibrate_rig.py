"""`rigkit calibrate` on a rig, from corners kept beside the session: the file, the words, the page, the exit code."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calibration.test_rig import mounts, rig_views, sizes

from rigkit.cli.main import main
from rigkit.detections import BoardDetection
from rigkit.io.corner_cache import CornerCache, FoundCorners
from rigkit.io.rig_file import load_rig
from rigkit.io.rig_session import load_rig_session

NAMES = ("reg", "wide")
SIGMAS = 4.0


@pytest.fixture
def session(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A session of two cameras whose images are gone, their corners kept: reg07.png and wide007.png are one frame."""
    true = np.linalg.norm(mounts()["wide"][1].translation_mm)
    cameras = "".join(f'[[cameras]]\nid = "{name}"\nimages = "{name}*.png"\n' for name in NAMES)
    (tmp_path / "9x6.toml").write_text(
        'schema = "rigkit.board/1"\ncolumns = 9\nrows = 6\nsquare_mm = 30.0\nsquare_sigma_mm = 0.3\n'
    )
    path = tmp_path / "session.toml"
    path.write_text(
        'schema = "rigkit.session/1"\nboard = "9x6.toml"\nmodel = "kannala_brandt"\nboard_shape = "flat"\n'
        f'{cameras}[[baselines]]\na = "wide"\nb = "reg"\nvalue_mm = {true}\nsigma_mm = 0.5\nhow = "drawing"\n'
    )
    views = rig_views(rng, 16)
    for name, own in load_rig_session(path).cameras.items():
        cache = CornerCache(own.corners_path, own.boards)
        for frame, view in views[name]:
            found = BoardDetection("9x6", 9, 6, view.grid, view.pixels, view.sigma_px)
            image = f"{name}{int(frame):0{2 if name == 'reg' else 3}d}.png"
            cache.put(image, "0" * 64, FoundCorners(sizes()[name], (found,)))
        cache.save()
    return path


def test_rig_from_kept_corners(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(session), "--json", "--report"]) == 0
    told = json.loads(capsys.readouterr().out)
    true = float(np.linalg.norm(mounts()["wide"][1].translation_mm))
    baseline = told["baselines"][0]
    assert abs(baseline["value_mm"] - true) < SIGMAS * baseline["sigma_mm"]
    # The squares are known to one per cent: no length is known better.
    assert 0.01 * true < baseline["sigma_mm"] < 0.011 * true
    rig = load_rig(session.parent / "rig.json")
    assert np.allclose(rig["wide"][1].matrix()[:3], told["cameras"][1]["cam_from_rig"])
    page = (session.parent / "rig.html").read_text()
    assert "Cameras of the rig" in page and 'id="wide"' in page and "drawing" in page

    assert main(["calibrate", str(session)]) == 2
    assert "--force" in capsys.readouterr().err

    session.write_text(session.read_text().replace("value_mm = 1", "value_mm = 2"))
    assert main(["calibrate", str(session), "--force"]) == 1
    assert "NOT as measured" in capsys.readouterr().out
