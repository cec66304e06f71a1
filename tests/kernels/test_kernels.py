"""`kernels` takes a library only for the source that it was built from."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest

from rigkit import kernels as native

FRONT = importlib.util.find_spec("rigkit.kernels._front")


@pytest.mark.skipif(FRONT is None, reason="the kernels are not built")
@pytest.mark.parametrize("source", ["its own", "changed", "gone"])
def test_a_library_counts_only_beside_its_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str) -> None:
    here = Path(native.__file__).parent
    current = native.kernels.__wrapped__("front") is not None
    shutil.copy(here / "kernels.h", tmp_path)
    if source != "gone":
        text = (here / "front.c").read_text(encoding="utf-8")
        (tmp_path / "front.c").write_text(text + ("" if source == "its own" else "\n/* */\n"), encoding="utf-8")
    monkeypatch.setattr(native, "__file__", str(tmp_path / "__init__.py"))
    found = native.kernels.__wrapped__("front")
    assert (found is not None) == (current and source == "its own")
