"""Boards of folders without a board file."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from rigkit.workflows.inputs import folder_session
from rigkit.workflows.inputs.folder_session import boards_seen
from rigkit.workflows.inputs.identify_board import Suggestion


@pytest.mark.parametrize(("beside", "said"), [((), False), (("7x5xMM", "15x5xMM"), True)])
def test_other_chessboards_are_left_out_but_named(
    beside: tuple[str, ...],
    said: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(folder_session, "_board_suggestion", lambda *_: Suggestion("11x7xMM", beside))
    with caplog.at_level(logging.INFO):
        assert boards_seen([tmp_path], 20.0) == ("11x7x20",)
    assert ("--board 7x5xMM --board 15x5xMM; give all" in caplog.text) == said
