"""Where the session and the results of folders go."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.workflows.calibration.calibrate_any import _session_path


@pytest.mark.parametrize(
    ("folders", "place"),
    [
        (["left", "right"], "."),
        (["photos"], "photos"),
        (["rig/left", "rig/right"], "rig"),
        (["../rig/left", "../rig/right"], "../rig"),
        (["left", "../right"], "."),
    ],
)
def test_results_are_named_as_the_folders_are(folders: list[str], place: str) -> None:
    places = [Path(folder) for folder in folders]
    assert _session_path(places, None) == Path(place) / "session.toml"
    mixed = [places[0].absolute(), *places[1:]]
    assert _session_path(mixed, None) == Path(place).absolute() / "session.toml"
