"""The pages of the documentation: every command and every block of Python runs, and every link has a target."""

from __future__ import annotations

import re
import shlex
import shutil
import textwrap
from pathlib import Path

import pytest
from helpers.data import REPOSITORY
from helpers.stereo_pictures import of_two_cameras

from rigkit.cli.main import main

FRAMES = 6
"""Photos that a page starts with: enough to calibrate."""
PAGES = REPOSITORY / "docs" / "pages"
MADE_BY_THE_BUILD = ("made/", "api.md", "code.md", "commands.md", "keys.md")
BLOCK = re.compile(r"^( *)```(console|python)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
NEEDS = re.compile(r"<!-- with: ([a-z ]+) -->")
LINK = re.compile(r"\]\(([^)\s]+)\)")
INCLUDED = re.compile(r'^--8<-- "(?!made/)(.+)"$', re.MULTILINE)
FIGURE = re.compile(r"\d+(?:[.,]\d+)*")


def set_up(needs: str, folder: Path, images: Path) -> None:
    """Lay out what a page starts from: photos of a board by one camera, by two, or the capture of the repository."""
    for need in needs.split():
        if need == "photos":
            (folder / "photos").mkdir()
            for k, path in enumerate(sorted(images.glob("left*.jpg"))[:FRAMES]):
                shutil.copy(path, folder / "photos" / f"{k}.jpg")
            # Stand for pictures taken later: other files with the same content.
            (folder / "new").mkdir()
            for name in ("0.jpg", "1.jpg"):
                (folder / "new" / name).write_bytes((folder / "photos" / name).read_bytes() + b"later")
        elif need == "rig":
            of_two_cameras(images, folder, FRAMES)
        else:
            assert need == "lab"
            (folder / "lab-a").symlink_to(REPOSITORY / "datasets" / "lab-a")


@pytest.mark.parametrize("page", sorted(p.name for p in PAGES.glob("*.md") if p.name not in MADE_BY_THE_BUILD))
def test_a_page_does_what_it_says(
    page: str,
    pictures: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = (PAGES / page).read_text(encoding="utf-8")
    needs = NEEDS.search(text)
    set_up(needs[1] if needs else "", tmp_path, pictures)
    monkeypatch.chdir(tmp_path)
    known: dict[str, object] = {}
    for indent, kind, block in BLOCK.findall(text):
        body = textwrap.dedent(block) if indent else block
        if kind == "python":
            exec(compile(body, page, "exec"), known)
            continue
        for line in body.splitlines():
            assert line.startswith("$ rigkit "), line
            code = main(shlex.split(line)[2:])
            assert code == 0, (line, capsys.readouterr().err)


def test_every_link_leads_somewhere() -> None:
    for path in [*PAGES.glob("*.md"), REPOSITORY / "README.md"]:
        text = INCLUDED.sub(lambda found: (REPOSITORY / found[1]).read_text(encoding="utf-8"), path.read_text("utf-8"))
        text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
        for target in LINK.findall(text):
            if target.startswith(("http", "#", *MADE_BY_THE_BUILD)):
                continue
            file, _, anchor = target.partition("#")
            there = path.parent / file
            assert there.exists(), f"{path.name}: {target}"
            if anchor:
                heads = re.findall(r"^#+ (.*)$", there.read_text(encoding="utf-8"), flags=re.MULTILINE)
                assert anchor in {re.sub(r"[^a-z0-9 -]", "", h.lower()).replace(" ", "-") for h in heads}, target


def figures(text: str) -> set[str]:
    return set(FIGURE.findall(text))


def test_figures_of_summaries_stand_on_the_pages_that_say_how_they_were_measured() -> None:
    """The overview's tables on the pages that their section links to, README's evidence on any of them."""
    overview = (PAGES / "accuracy.md").read_text(encoding="utf-8")
    evidence = (REPOSITORY / "README.md").read_text(encoding="utf-8").partition("## Evidence")[2].partition("\n## ")[0]
    homes = [*PAGES.glob("accuracy-*.md"), PAGES / "speed.md"]
    summaries = [(evidence, homes)]
    for section in overview.split("\n## ")[1:]:
        pages = [PAGES / target for target in LINK.findall(section) if target.endswith(".md")]
        summaries.append((section, pages))
    checked = 0
    for text, pages in summaries:
        known = figures("\n".join(page.read_text(encoding="utf-8") for page in pages))
        for row in re.findall(r"^\|.*\d.*\|$", text, re.MULTILINE):
            assert figures(LINK.sub("", row)) <= known, f"{figures(row) - known} of: {row}"
            checked += 1
    assert checked > 30


def test_files_that_contributing_names_exist() -> None:
    text = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w/]+\.(?:py|pyi|txt|md|yml|c))(?: [^`]*)?`", text))
    known = {
        path.as_posix() for room in ("rigkit", "tests", "scripts", "docs") for path in (REPOSITORY / room).rglob("*.*")
    }
    assert len(named) > 30
    lost = {name for name in named if not any(path.endswith("/" + name) for path in known)}
    assert not lost
