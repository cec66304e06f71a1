"""Sigmas against true errors: 400 noisy corner sets of random captures, through the whole chain.

Cameras are either exact, or calibrated anew for every capture from noisy corners: then the calibration's own
uncertainty is a large part of every sigma.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from helpers.board_scenes import fisheye_camera, noisy_pair, regular_camera
from helpers.calibration_scenes import REACH_DEG, lens
from helpers.recalibrations import (
    SIGMA_PX,
    Calibrate,
    random_scene,
    recalibration,
)
from helpers.reconstructions import BOARDS

from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.posetype import PoseType
from rigkit.core.truth import MeasuredAngle, MeasuredLength, PairTruth
from rigkit.reconstruction.calibration_shifts import calibration_shifts
from rigkit.reconstruction.reconstruct import reconstruct_pair
from rigkit.synthetic.pairs import StereoScene
from rigkit.validation.checks import ValidationReport, validate

DRAWS = 400
WITHIN_ONE, WITHIN_TWO = (0.63, 0.73), (0.92, 0.98)
"""68.3 and 95.4 % for a Gaussian; 1200 angles, three of a scene correlated, are good to about 1.8 and 0.8 %."""
WITHIN_ONE_BASELINE, WITHIN_TWO_BASELINE = (0.58, 0.78), (0.91, 0.99)
"""One baseline a draw: 2.3 and 1 %."""
PAIRS = (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))
TYPES = (PoseType.GENERAL, PoseType.STANDARD, PoseType.FORWARD)


def report_of(scene: StereoScene, rng: np.random.Generator, calibrate: Calibrate | None = None) -> ValidationReport:
    """Return one noisy capture judged against the exact truth, with one estimator."""
    truth = PairTruth(
        MeasuredLength(scene.baseline_mm, 1e-9, "made"),
        tuple(MeasuredAngle(a, b, 90.0, 1e-9, "made") for a, b in PAIRS),
    )
    camera, covariance = (scene.camera1, None) if calibrate is None else calibrate()
    matched = noisy_pair(scene, BOARDS, rng, SIGMA_PX, known_as=camera)
    reconstruction = reconstruct_pair(matched, pose_type=scene.pose_type)
    shifts = None
    if covariance is not None:
        known = UncertainCamera(camera, covariance)
        shifts = calibration_shifts(reconstruction, known)
    return validate(reconstruction, truth, shifts=shifts)


def shares(values: Sequence[float]) -> tuple[float, float]:
    k = np.array(values)
    return float(np.mean(k < 1.0)), float(np.mean(k < 2.0))


def assert_honest(reports: Sequence[ValidationReport]) -> None:
    angles = [check.k for report in reports for check in report.checks if check.kind == "angle"]
    baselines = [report.check("baseline").k for report in reports]
    # What the calibration bends, or an epipole blows up, is no corner that something covers.
    assert not [note for report in reports for note in report.notes if "outliers of its plane" in note]
    assert len(angles) == 3 * len(baselines) == 3 * DRAWS
    found = {"angles": shares(angles), "baselines": shares(baselines)}
    assert WITHIN_ONE[0] <= found["angles"][0] <= WITHIN_ONE[1], found
    assert WITHIN_TWO[0] <= found["angles"][1] <= WITHIN_TWO[1], found
    assert WITHIN_ONE_BASELINE[0] <= found["baselines"][0] <= WITHIN_ONE_BASELINE[1], found
    assert WITHIN_TWO_BASELINE[0] <= found["baselines"][1] <= WITHIN_TWO_BASELINE[1], found


@pytest.mark.slow
@pytest.mark.parametrize("pose_type", TYPES)
@pytest.mark.parametrize("camera", [regular_camera(), fisheye_camera()], ids=["regular", "fisheye"])
def test_with_exact_cameras(rng: np.random.Generator, camera: Camera, pose_type: PoseType) -> None:
    assert_honest([report_of(random_scene(camera, pose_type, rng), rng) for _ in range(DRAWS)])


@pytest.mark.slow
@pytest.mark.parametrize("pose_type", TYPES)
@pytest.mark.parametrize("name", ["reg", "fish"])
def test_with_cameras_calibrated_from_noisy_corners(rng: np.random.Generator, name: str, pose_type: PoseType) -> None:
    camera = lens(name)
    calibrate = recalibration(camera, REACH_DEG[name], rng)
    assert_honest([report_of(random_scene(camera, pose_type, rng), rng, calibrate) for _ in range(DRAWS)])
