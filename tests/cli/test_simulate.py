"""`rigkit simulate`: files, output, exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rigkit.cli.main import main

STUDY = """
schema = "rigkit.study/1"
name = "small"
trials = 10
seed = 3
pose_types = ["standard"]
methods = ["F3UDIR", "3SDIR"]

[noise]
on = "directions"
sigma_deg = [0, 2]

[[claims]]
text = "lengths help"
smaller = { method = "3SDIR" }
larger = { method = "F3UDIR" }
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def test_tables_and_figure_are_written(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["simulate", str(study), "-o", str(out)]) == 0
    assert sorted(p.name for p in out.iterdir()) == ["small.csv", "small.html", "small.json", "small.md", "small.png"]
    printed = capsys.readouterr()
    assert printed.out.strip() == (out / "small.md").read_text().strip()
    assert "| lengths help | **" in printed.out
    assert (out / "small.png").read_bytes().startswith(b"\x89PNG")
    result = json.loads((out / "small.json").read_text())
    assert len(result["cells"]) == 2 * 2 * 4
    # Nothing is replaced without --force.
    assert main(["simulate", str(study), "-o", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    before = (out / "small.json").read_bytes()
    assert main(["simulate", str(study), "-o", str(out), "--force", "--jobs", "2", "--json", "--format", "pdf"]) == 0
    assert (out / "small.json").read_bytes() == before
    assert json.loads(capsys.readouterr().out) == [result]
    assert (out / "small.pdf").read_bytes().startswith(b"%PDF")


def test_bad_input(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", str(tmp_path / "none.toml"), "-o", str(tmp_path)]) == 2
    assert main(["simulate", str(study), str(study), "-o", str(tmp_path)]) == 2
    assert "same name" in capsys.readouterr().err
    assert main(["simulate", str(study), "-o", str(tmp_path / "out"), "--trials", "0"]) == 2
    assert not (tmp_path / "out").exists()
