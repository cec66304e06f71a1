"""The oldest packages that pyproject.toml allows are those that the public workflow installs and tests."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_workflow_tries_the_lower_bounds() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    bounds = dict(each.split(">=") for each in project["dependencies"])
    pins = dict(re.findall(r"'([\w-]+)==([\d.]+)\.\*'", (ROOT / ".github/workflows/wheels.yml").read_text()))
    assert len(pins) >= 6
    assert pins == {name: bounds[name] for name in pins}
