"""Every public object prints in a few lines, whatever it holds."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import lens, random_views
from helpers.rig_scenes import calibrated_rig

import rigkit
from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.compare import compare_cameras
from rigkit.core.findings import Finding, Severity
from rigkit.core.printing import brief, digits, length_words
from rigkit.reconstruction.geometry import PairGeometry
from rigkit.reconstruction.metric import MetricPose
from rigkit.relative_pose.refinement.refine import RefinedPose
from rigkit.validation.planes import Plane
from rigkit.workflows.reconstruction.reconstruct import PairReconstruction
from rigkit.workflows.validation.validation_files import PairValidation

MAX_LINES = 5
COLUMNS = 120

PUBLIC: dict[str, type[Any]] = {
    name: found
    for name, found in ((name, getattr(rigkit, name)) for name in rigkit.__all__)
    if inspect.isclass(found) and dataclasses.is_dataclass(found)
}
HELD = (PairGeometry, MetricPose, RefinedPose, Plane, PairReconstruction, PairValidation)
"""What public results hold, and a person looks at."""
PUBLIC |= {kind.__name__: kind for kind in HELD}
BULK = (
    np.arange(6000.0).reshape(1000, 6),
    tuple(f"a note that says much, number {k}" for k in range(400)),
    {f"image{k}": np.zeros((9, 9)) for k in range(300)},
    "a message\nof several lines " * 40,
    1.0 / 3.0,
    Path("/a/long/path") / ("x" * 200),
    Finding(severity=Severity.LOOK, message="m" * 300),
)


def filled(kind: type[Any], shift: int, values: tuple[Any, ...] = BULK) -> Any:
    """Return an object of that class whose fields hold much, whatever they are declared to hold."""
    made = object.__new__(kind)
    for k, field in enumerate(dataclasses.fields(kind)):
        object.__setattr__(made, field.name, values[(k + shift) % len(values)])
    return made


def with_words_of_its_own(name: str) -> Any:
    """Return an object of a class that prints itself in another way."""
    camera = lens("reg")
    if name == "Calibration":
        views = random_views(camera, 8, np.random.default_rng(1), reach_deg=24.0, noise_px=0.1)[0]
        return calibrate(views, camera.size_px, model="brown")
    if name == "RigCalibration":
        rig = calibrated_rig()
        renamed = [dataclasses.replace(camera, name=f"camera with number {k}") for k, camera in enumerate(rig.cameras)]
        return dataclasses.replace(rig, cameras=tuple(renamed))
    made = {
        "Board": lambda: rigkit.Board("plane1", 8, 6, 50.0, 50.0),
        "Camera": lambda: camera,
        "CameraDifference": lambda: compare_cameras(camera, camera),
        "Rigid3": rigkit.Rigid3.identity,
        "Task": lambda: rigkit.Task(quantity=rigkit.Quantity.LENGTH, size_mm=100.0, distance_mm=1000.0),
    }
    return made[name]()


def lines_of(words: str) -> int:
    return sum(-(-max(len(line), 1) // COLUMNS) for line in words.splitlines())


@pytest.mark.parametrize("name", PUBLIC)
def test_it_prints_in_a_few_lines(name: str) -> None:
    kind = PUBLIC[name]
    if vars(kind).get("__repr__") is brief:
        printed = [repr(filled(kind, shift)) for shift in range(len(BULK))]
    elif name.endswith("Options"):
        printed = [repr(filled(kind, 0, (Path("folder/session.toml"), 0.1, None, ("ros", "opencv"))))]
    else:
        printed = [repr(with_words_of_its_own(name))]
    for words in printed:
        assert name.removesuffix("Camera") in words or name == "Camera"
        assert lines_of(words) <= MAX_LINES, words


def test_values_are_shown_where_they_are_short() -> None:
    found = rigkit.BoardDetection("a", 3, 2, np.array([[0, 0], [1, 0]]), np.zeros((2, 2)), np.full(2, 0.1))
    assert repr(found) == "BoardDetection(board_id='a', columns=3, rows=2, grid=<2x2>, pixels=<2x2>, sigma_px=<2>)"


def test_small_lengths_are_not_shown_as_nothing() -> None:
    """Of a rig under a microscope; what is nothing is no rest of rounding."""
    lengths = ((99.934, -0.00412), (-0.00412, 0.0), (0.0,), (1e-9,), (0.000004,))
    words = [length_words(*each, decimals=2) for each in lengths]
    assert words == ["99.93, -0.00", "-0.0041, 0.0000", "0.00", "0.00", "0.000004"]


def test_large_numbers_have_no_exponent() -> None:
    assert [digits(value) for value in (523.4, 5.23, 0.0523)] == ["520", "5.2", "0.052"]
