"""Every verb's help ends with examples that its parser takes."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
import sys

import pytest

from rigkit.affine.registry import AFFINE_METHODS
from rigkit.cameras import registry
from rigkit.cli import reconstruct
from rigkit.cli.main import EXAMPLES, FIRST_STEPS, VERBS, build_parser
from rigkit.io.disk.schema_builders import attributes_of
from rigkit.workflows.options.cameras import FolderOptions

MAX_WIDTH = 120
"""A terminal of usual width shows a line whole."""


def typed(text: str) -> list[list[str]]:
    """Return the words of every command in examples, without what is said of them after two spaces."""
    lines = re.sub(r"\\\n\s+", "", text).strip().splitlines()
    return [shlex.split(re.split(r"\s{2,}", line.strip())[0]) for line in lines]


@pytest.mark.parametrize("verb", VERBS)
def test_examples_are_what_the_parser_takes(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    examples = (importlib.import_module(f"rigkit.cli.{verb}").__doc__ or "").partition(EXAMPLES)[2]
    commands = typed(examples)
    assert commands
    for program, *words in commands:
        assert program == "rigkit"
        assert words[0] == verb
        build_parser(verb).parse_args(words)
    with pytest.raises(SystemExit):
        build_parser(verb).parse_args([verb, "--help"])
    assert examples.rstrip() in capsys.readouterr().out
    assert max(map(len, examples.splitlines())) <= MAX_WIDTH


def test_without_a_verb_the_first_steps_are_shown() -> None:
    done = subprocess.run([sys.executable, "-m", "rigkit"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert FIRST_STEPS in done.stderr
    assert done.stdout == ""
    for line in FIRST_STEPS.split("\n\n")[0].splitlines()[1:-1]:
        (_, verb, *words), *_ = typed(line)
        build_parser(verb).parse_args([verb, *words])


def test_help_lists_the_camera_models_and_the_affine_estimators() -> None:
    assert attributes_of(FolderOptions)["model"].startswith(f"{', '.join(registry.MODELS)} (")
    assert AFFINE_METHODS == reconstruct.METHODS
