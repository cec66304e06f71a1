"""Arguments made from the fields of option classes."""

import argparse
import importlib
import re
import subprocess
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import pytest

from rigkit.cli.console import add_options, options_of
from rigkit.cli.main import VERBS, main
from rigkit.io.disk.schema_builders import attributes_of
from rigkit.workflows.options import boards, cameras, clouds, coach
from rigkit.workflows.options.base import WrittenFiles

KINDS = [
    kind
    for module in (boards, cameras, clouds, coach)
    for name, kind in vars(module).items()
    if name.endswith("Options")
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample(WrittenFiles):
    """Options of every type.

    Attributes
    ----------
    output : file to write, 100 % new.
    before : earlier images.
    pairs : only this pair.
    names : of two
        cameras.
    chain : pixels to use.
    one_view : seen from one place.
    depth : of a tree.
    """

    output: Path
    before: tuple[Path, ...] = ()
    pairs: tuple[str, ...] = ()
    names: tuple[str, str] | None = None
    chain: Literal["raw", "rectified"] = "raw"
    one_view: bool | None = None
    depth: int = 9


@pytest.fixture
def parser() -> argparse.ArgumentParser:
    out = argparse.ArgumentParser()
    add_options(out, Sample, output="-o FILE", before="IMAGE...", pairs="-p --pair ID", names="ONE TWO", chain="")
    add_options(out, Sample, one_view="", depth="N", force="")
    return out


def test_arguments_have_the_types_of_the_fields(parser: argparse.ArgumentParser) -> None:
    typed = "-o a.png --before b.png c.png --pair d -p e --names f g --chain rectified --no-one-view --depth 3 --force"
    made = options_of(Sample, parser.parse_args(typed.split()))
    assert made == Sample(
        output=Path("a.png"),
        before=(Path("b.png"), Path("c.png")),
        pairs=("d", "e"),
        names=("f", "g"),
        chain="rectified",
        one_view=False,
        depth=3,
        force=True,
    )


def test_arguments_left_out_have_the_defaults_of_the_fields(parser: argparse.ArgumentParser) -> None:
    assert options_of(Sample, parser.parse_args(["-o", "a.png"])) == Sample(output=Path("a.png"))


@pytest.mark.parametrize("typed", ["", "-o a --chain raws", "-o a --names f", "-o a --depth deep"])
def test_what_a_field_cannot_hold_is_refused(parser: argparse.ArgumentParser, typed: str) -> None:
    with pytest.raises(SystemExit):
        parser.parse_args(typed.split())


def test_help_is_the_description_of_the_field_with_its_default(parser: argparse.ArgumentParser) -> None:
    words = " ".join(parser.format_help().split())
    assert "--output FILE file to write, 100 % new --before IMAGE [IMAGE ...] earlier images" in words
    assert "--pair ID only this pair (repeatable) --names ONE TWO of two cameras" in words
    assert "--chain {raw,rectified} pixels to use (default: raw)" in words
    assert "--depth N of a tree (default: 9) --force replace existing files; input files are never replaced" in words


@pytest.mark.parametrize("kind", KINDS)
def test_every_field_of_options_is_described_and_nothing_else(kind: type) -> None:
    assert set(attributes_of(kind)) == {field.name for field in fields(kind)}


@pytest.mark.parametrize("verb", VERBS)
def test_without_docstrings_a_verb_has_help(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.import_module(f"rigkit.cli.{verb}"), "__doc__", None)
    monkeypatch.setattr("rigkit.cli.console.attributes_of", lambda kind: {})
    with pytest.raises(SystemExit, match="0"):
        main([verb, "--help"])
    assert "--log-file" in capsys.readouterr().out


@pytest.mark.thorough
def test_without_docstrings_all_verbs_work() -> None:
    """`python -OO` compiles all packages anew."""
    code = f"from rigkit.cli.main import build_parser\nfor verb in {list(VERBS)}: build_parser(verb).format_help()"
    subprocess.run([sys.executable, "-OO", "-c", code], check=True)


@pytest.mark.parametrize(
    "command",
    [
        "export camera.json --to opencv -o new/",
        "detect a.png --board 9x6x30 -o new/",
        "plan camera.json -r new/",
        "check camera.json a.png --register new/",
        "mesh cloud.ply -o new/",
        "init photos --session -o new/",
        "schema session -o new/",
        "history register.jsonl -r new/",
        "calibrate photos -o new/",
        "calibrate photos -r new/",
        "board 9x6 --square-mm 25 -o new/",
        "detect a.png --log-file new/",
    ],
)
def test_a_file_is_not_called_as_folders_are(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the slash it would be written as a file of that name."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        sys.exit(main(command.split()))
    assert re.search(r"-[a-z-]+:? 'new/' names a folder; give a file", capsys.readouterr().err)
    assert not list(tmp_path.iterdir())
