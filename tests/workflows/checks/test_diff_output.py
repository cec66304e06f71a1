"""The words of `rigkit diff` agree with its figures."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.calibration_scenes import lens

from rigkit.calibration.compare import CalibrationComparison
from rigkit.cameras.compare import compare_cameras
from rigkit.core.errors import InputError
from rigkit.io.calibrations.calibration_file import save_camera
from rigkit.io.calibrations.rig_file import load_saved_rig
from rigkit.workflows.checks.diff import CameraPair, diff
from rigkit.workflows.checks.diff_output import words_of, write_diff_page


@pytest.mark.parametrize(("typical_times", "surer"), [((0.5, 5.0), True), ((0.1, 0.5), False)])
def test_another_camera_that_differs_by_no_more_than_usual(typical_times: tuple[float, float], surer: bool) -> None:
    """Rms and chance ask different things: where most of what is usual is of one kind, little of another is none."""
    camera = lens("reg")
    difference = compare_cameras(camera, camera.with_parameters(camera.parameters * [1.002, 1.0, *[1.0] * 7]))
    low, high = (times * difference.rms_px for times in typical_times)
    compared = CalibrationComparison(difference, 0.5 * (low + high), (low, high), 0.001, True)
    words = words_of(CameraPair(difference, compared))[-1]
    assert "another camera or a moved lens" in words
    assert ("but where both are more certain (p = 0.001)" in words) == surer


def test_a_page_of_files_with_one_name_names_their_folders(tmp_path: Path) -> None:
    camera = lens("reg")
    pair = CameraPair(compare_cameras(camera, camera.with_parameters(camera.parameters * [1.002, *[1.0] * 8])), None)
    files = tmp_path / "before" / "calibration.json", tmp_path / "after" / "calibration.json"
    for path in files:
        path.parent.mkdir()
        path.touch()
    write_diff_page(tmp_path / "page.html", pair, files, force=False)
    page = (tmp_path / "page.html").read_text()
    assert "rigkit diff: before/calibration.json and after/calibration.json" in page and "B after/" in page


def test_files_of_another_kind_are_named_as_what_they_are(tmp_path: Path) -> None:
    rig, camera = tmp_path / "rig.json", tmp_path / "camera.json"
    rig.write_text('{"schema": "rigkit.rig/1"}')
    save_camera(camera, lens("reg"))
    with pytest.raises(InputError, match="a rig and a camera"):
        diff(rig, camera)
    with pytest.raises(InputError, match=r"none\.json' does not exist"):
        diff(rig, tmp_path / "none.json")
    # Calibrating again would not make it a rig.
    with pytest.raises(InputError, match="is a calibration file; give a rig file instead"):
        load_saved_rig(camera)
    rig.write_text('{"schema": "rigkit.rig/0"}')
    with pytest.raises(InputError, match="calibrate again"):
        load_saved_rig(rig)
