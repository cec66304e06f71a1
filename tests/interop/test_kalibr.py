"""Kalibr's camchains of rigs."""

from __future__ import annotations

import numpy as np
from helpers.cameras import sample_cameras

from rigkit.cameras.scaramuzza import Scaramuzza
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.kalibr import read_kalibr, write_kalibr


def test_refits_of_a_kalibr_rig_are_of_one_model() -> None:
    """Alone, the first of these lenses is nearest to a EUCM camera, the second to a Kannala-Brandt one."""
    polynomials = ([850.4, -5.6e-4, 3.95e-9, -6.61e-12], [850.4, -5.44e-4, 1.95e-8, 5.73e-11])
    lenses = [Scaramuzza((1280, 960), np.array([*p, 648.0, 467.0, 1.0, 0.0])) for p in polynomials]
    poses = [Rigid3.identity(), Rigid3(np.eye(3), [-100.0, 0.0, 0.0]), Rigid3(np.eye(3), [-200.0, 0.0, 0.0])]
    alone = {write_kalibr([lens]).cameras[0].camera.model for lens in lenses}
    assert alone == {"eucm", "kannala_brandt"}
    cameras, _ = read_kalibr(write_kalibr([*lenses, sample_cameras()["double_sphere"]], poses).text)
    assert cameras[0].model == cameras[1].model
    assert cameras[2].model == "double_sphere"
