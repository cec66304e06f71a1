"""Known cameras of a rig's session, from the files that it names."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.io.calibrations.calibration_file import save_calibration
from rigkit.io.manifests.rig_session import RigSession
from rigkit.io.manifests.session import Session
from rigkit.workflows.inputs.known_cameras import known_cameras


def test_a_lens_that_was_calibrated_alone_has_the_covariance_of_its_file(
    calibration: Calibration, tmp_path: Path
) -> None:
    alone = tmp_path / "alone.json"
    save_calibration(alone, calibration)
    session = RigSession(
        path=tmp_path / "session.toml",
        cameras=dict.fromkeys(["left", "right"], cast(Session, None)),
        frames="number",
        baselines=(),
        lenses={"right": alone},
    )
    known = known_cameras(session)
    assert known is not None and known.cameras["right"][1] is None
    np.testing.assert_array_equal(known.cameras["right"][0].parameters, calibration.camera.parameters)
    covariance, count = known.of_lens("right"), calibration.camera.parameters.size
    assert covariance is not None
    # Departures, which are stated apart, are not in it; what the noise adds is of the same size.
    sigma = np.sqrt(np.diag(covariance) / np.diag(calibration.covariance)[:count])
    assert sigma.min() > 0.8 and sigma.max() < 1.5
    assert known.departures["right"].moves.shape[0] == count
