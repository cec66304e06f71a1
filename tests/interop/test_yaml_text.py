"""YAML within limits: calibration files are read; tags, duplicates and deep nesting are refused."""

from __future__ import annotations

import pytest

from rigkit.core.errors import InputError
from rigkit.interop.yaml_text import MAX_CHARACTERS, MAX_DEPTH, flow, parse_yaml

OPENCV = """%YAML:1.0
---
calibration_time: "Fri 01 Mar 2024 10:20:30"
image_width: 640
K: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ 1., -2.5e-03, 1e-5,
       .5 ]
"""


def test_what_opencv_writes() -> None:
    data = parse_yaml(OPENCV, "f")
    assert data["image_width"] == 640 and data["calibration_time"].startswith("Fri")
    assert data["K"] == {"rows": 1, "cols": 4, "dt": "d", "data": [1.0, -2.5e-3, 1e-5, 0.5]}


def test_doubles_come_back() -> None:
    values = [1e-300, -0.1, 12345678.9, 1e22, 3]
    assert parse_yaml(f"a: {flow(values)}", "f") == {"a": values}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &x [1]\nb: *x\n", "alias"),
        ("a: 1\na: 2\n", "'a' is given twice"),
        ("a:\n  b: 1\n  b: 2\n", "line 3: 'b' is given twice"),
        ("[" * 300, f"more than {MAX_DEPTH}"),
        ("a: !!python/object/apply:os.getcwd []\n", "python"),
        ("a: [1, 2\n", "line"),
        ("a: \x00", "not readable"),
        ("- 1\n", "not a mapping"),
        ("", "not a mapping"),
        ("a: 1\n" + "#" * MAX_CHARACTERS, "characters"),
    ],
)
def test_dangerous_yaml_is_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        parse_yaml(text, "file.yaml")
    assert "file.yaml" in str(caught.value) and "\n" not in str(caught.value)


def test_words_that_yaml_1_1_turns_into_something_else_stay_words() -> None:
    assert parse_yaml("a: no\nb: 2024-01-02\nc: 1:30\nd: 0x1f\n", "f") == {
        "a": "no", "b": "2024-01-02", "c": "1:30", "d": "0x1f",
    }  # fmt: skip
