"""Departures of a rig's lenses from their models count once: not as noise of corners and frames as well."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from helpers.rig_scenes import MODELS, NOISE_PX, SIGMAS, mounts, rig_views, sizes

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.solving.known import KnownCameras
from rigkit.io.calibrations.rig_file import load_saved_rig, rig_text
from rigkit.io.manifests.rig_session import RigSession
from rigkit.io.manifests.session import Session
from rigkit.kernels.departures import DISPLACEMENTS, displacements
from rigkit.validation.monitoring.watch import monitored_rig
from rigkit.workflows.inputs.known_cameras import known_cameras

DECENTRED_PX = 2.0
AS_UNCERTAIN = 0.05
"""Weights of corners follow from each solution's residuals."""


def test_departures_of_two_lenses_are_no_noise_of_frames(tmp_path: Path) -> None:
    amounts, views = np.zeros(DISPLACEMENTS), rig_views(np.random.default_rng(2), 12)
    amounts[5:7] = DECENTRED_PX, -DECENTRED_PX
    for name in ("wide", "fish"):
        size = sizes()[name]
        moved = [np.einsum("ijn,j->ni", displacements(view.pixels, size), amounts) for _, view in views[name]]
        views[name] = [
            (frame, replace(view, pixels=np.clip(view.pixels + by, 0.0, np.array(size) - 1.0)))
            for (frame, view), by in zip(views[name], moved, strict=True)
        ]
    rig = calibrate_rig(views, sizes(), model=MODELS, folds=0)
    # Its cameras have the scatter of all residuals, the rig that of the rest.
    assert all(camera.calibration.overdispersion > 1.4 for camera in rig.cameras)
    assert rig.overdispersion < 1.15
    assert rig.sigma_px == pytest.approx(NOISE_PX, rel=0.03)
    length, sigma = rig.baseline_mm("reg", "fish")
    assert abs(length - np.linalg.norm(mounts()["fish"][1].inverse().translation_mm)) < SIGMAS * sigma
    (tmp_path / "rig.json").write_text(rig_text(rig), encoding="utf-8")
    again = load_saved_rig(tmp_path / "rig.json")
    one, other = (monitored_rig(own) for own in (rig.mounted, again))
    for name in ("covariance", "expected"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-9, abs=1e-30)
    # What is expected is a part of the covariance.
    assert 0.0 < np.trace(one.mean_products) < np.trace(one.covariance)
    scale = 1.0 / np.sqrt(np.diag(one.covariance))
    assert np.linalg.eigvalsh((one.covariance - one.mean_products) * scale[:, None] * scale)[0] > -1e-9
    # A camera that is added to this rig takes lenses and mounts to be as uncertain as the rig says.
    session = RigSession(
        path=tmp_path / "more.toml",
        cameras=dict.fromkeys([*sizes(), "more"], cast(Session, None)),
        frames="number",
        baselines=(),
        known_rig=tmp_path / "rig.json",
    )
    known = known_cameras(session)
    assert known is not None and known.covariance is not None
    assert known.covariance == pytest.approx(rig.widening**2 * rig.covariance, rel=1e-9)
    for name, modes in zip(sizes(), rig.departures, strict=True):
        assert known.departures[name].moves == pytest.approx(modes.moves, rel=1e-9)
    beyond = rig.sigmas**2 - rig.widening**2 * np.diag(rig.covariance)
    assert (beyond > 0.5 * np.diag(rig.covariance)).any()
    # Held at this result, the lenses leave the mounts as uncertain as it does: their errors were compensated.
    cameras = {camera.name: (camera.camera, None) for camera in rig.cameras}
    held = calibrate_rig(views, sizes(), known=KnownCameras.of(cameras, [(rig.mounted, list(cameras))]), folds=0)
    assert held.baseline_mm("reg", "fish") == pytest.approx((length, sigma), rel=AS_UNCERTAIN)
    held_moves, own_moves = (np.concatenate([m.moves[-12:] for m in r.departures], axis=1) for r in (held, rig))
    assert (np.linalg.norm(held_moves - own_moves, axis=1) < AS_UNCERTAIN * np.linalg.norm(own_moves, axis=1)).all()
