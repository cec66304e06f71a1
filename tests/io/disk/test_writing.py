"""Places where nothing can be written are refused before any work is done."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rigkit.core.errors import InputError
from rigkit.io.disk.writing import ensure_folder_writable, ensure_writable


def test_a_folder_without_permission_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also for folders below it that would have to be made."""
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    target = tmp_path / "new" / "calibration.json"
    with pytest.raises(InputError, match=r"calibration\.json': no permission in '.*'; choose another folder"):
        ensure_writable((target,), force=False)
    with pytest.raises(InputError, match="no permission"):
        ensure_folder_writable(target.parent)
    (tmp_path / "new").mkdir()
    ensure_writable((target,), force=False)
