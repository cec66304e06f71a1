"""`rigkit fetch`: public captures from a server or from a local folder, checked by their hashes."""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from helpers.data import REPOSITORY, shared_data

from rigkit.cli.main import main
from rigkit.core.errors import ExitCode, InputError
from rigkit.io.manifests.public_set import load_public_set
from rigkit.workflows.fetch import fetch_public_set, public_sets

CONTENT = b"an image"

MANIFEST = """
schema = "rigkit.public/1"
name = "small"
about = "two files"
rendered = false
source = "https://example.org/small"
licence = "MIT"
folder = "public/small"

[[boards]]
id = "board"
columns = 9
rows = 6
square_mm = 30.0

[[measured]]
id = "baseline"
value = 120.0
unit = "mm"
how = "nominal"

[files]
"left/01.png" = "{sha}"
"right/01.png" = "{sha}"
"""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """A server of a folder with one file, on this machine alone."""
    (tmp_path / "served").mkdir()
    (tmp_path / "served" / "01.png").write_bytes(CONTENT)
    own = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "served")))
    thread = threading.Thread(target=own.serve_forever, args=(0.01,))
    thread.start()
    yield f"http://127.0.0.1:{own.server_port}"
    own.shutdown()
    thread.join()
    own.server_close()


def described(folder: Path, urls: dict[str, str], content: bytes = CONTENT) -> Path:
    """Write the description of a set whose files have this content, and return its folder."""
    catalogue = folder / "catalogue"
    catalogue.mkdir()
    text = MANIFEST.format(sha=hashlib.sha256(content).hexdigest())
    if urls:
        text += "\n[urls]\n" + "".join(f'"{name}" = "{url}"\n' for name, url in urls.items())
    (catalogue / "small.toml").write_text(text)
    return catalogue


def test_fetched_from_a_server_and_not_again(tmp_path: Path, server: str, capsys: pytest.CaptureFixture[str]) -> None:
    urls = {"left/01.png": f"{server}/01.png", "right/01.png": (tmp_path / "served" / "01.png").as_uri()}
    where = ["--catalogue", str(described(tmp_path, urls)), "-o", str(tmp_path / "data")]
    assert main(["fetch", "small", *where]) == ExitCode.WELL
    for side in ("left", "right"):
        assert (tmp_path / "data/public/small" / side / "01.png").read_bytes() == CONTENT
    assert "2 files" in capsys.readouterr().out
    (tmp_path / "served" / "01.png").unlink()
    assert main(["fetch", "small", *where]) == ExitCode.WELL
    assert "0 of them new" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["gztar", "tar", "zip"])
def test_files_of_an_archive(tmp_path: Path, server: str, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    inside = tmp_path / "inside/set"
    inside.mkdir(parents=True)
    (inside / "01.png").write_bytes(CONTENT)
    (inside / "other.txt").write_bytes(b"of no use")
    archive = Path(shutil.make_archive(str(tmp_path / "served" / "all"), kind, inside.parent, "set"))
    urls = {f"{side}/01.png": f"{server}/{archive.name}#set/01.png" for side in ("left", "right")}
    where = ["--catalogue", str(described(tmp_path, urls)), "-o", str(tmp_path / "data")]
    assert main(["fetch", "small", *where]) == ExitCode.WELL
    found = sorted(path.relative_to(tmp_path / "data") for path in (tmp_path / "data").rglob("*") if path.is_file())
    assert found == [Path("public/small/left/01.png"), Path("public/small/right/01.png")]
    archive.unlink()
    assert main(["fetch", "small", *where]) == ExitCode.WELL
    assert "0 of them new" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("served", "member", "says"),
    [
        (None, "set/none.png", "there is no 'set/none.png' in it"),
        (b"no archive", "set/01.png", "no .tar or .zip"),
        (None, "set/other.txt", "SHA-256"),
    ],
)
def test_a_wrong_archive_leaves_nothing(tmp_path: Path, served: bytes | None, member: str, says: str) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "set/01.png").write_bytes(CONTENT)
    (tmp_path / "set/other.txt").write_bytes(b"of no use")
    archive = Path(shutil.make_archive(str(tmp_path / "all"), "gztar", tmp_path, "set"))
    if served is not None:
        archive.write_bytes(served)
    catalogue = described(tmp_path, {"left/01.png": f"{archive.as_uri()}#{member}"})
    with pytest.raises(InputError, match=says):
        fetch_public_set(public_sets(catalogue)["small"], tmp_path / "data")
    assert not [path for path in (tmp_path / "data").rglob("*") if path.is_file()]


def test_files_without_an_address_are_reported(
    tmp_path: Path, server: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    catalogue = described(tmp_path, {"left/01.png": f"{server}/01.png"})
    monkeypatch.setenv("RIGKIT_DATA", str(tmp_path / "elsewhere"))
    assert main(["fetch", "--catalogue", str(catalogue)]) == ExitCode.WELL
    assert "the addresses of the others are not known: see " in capsys.readouterr().out
    assert main(["fetch", "small", "--catalogue", str(catalogue), "--json"]) == ExitCode.CHECK_FAILED
    out = capsys.readouterr()
    assert json.loads(out.out)["small"]["missing"] == ["right/01.png"]
    assert "https://example.org/small" in out.err
    assert (tmp_path / "elsewhere/public/small/left/01.png").is_file()


def test_another_file_is_refused(tmp_path: Path, server: str, capsys: pytest.CaptureFixture[str]) -> None:
    for k, url in enumerate((f"{server}/01.png", f"{server}/none.png", (tmp_path / "served" / "01.png").as_uri())):
        folder = tmp_path / str(k)
        folder.mkdir()
        catalogue = described(folder, {"left/01.png": url}, b"another image")
        assert main(["fetch", "small", "--catalogue", str(catalogue), "-o", str(folder)]) == ExitCode.BAD_INPUT
        assert not list(folder.rglob("*.png"))
        assert "rigkit: " in capsys.readouterr().err
    kept = folder / "public/small/left/01.png"
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_bytes(CONTENT)
    with pytest.raises(InputError, match="SHA-256"):
        fetch_public_set(public_sets(catalogue)["small"], folder)


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ('"left/01.png"', '"../01.png"', "leaves the folder"),
        ('folder = "public/small"', 'folder = "/etc"', "leaves the folder"),
        ('unit = "mm"', 'unit = "inch"', "unit"),
        ("[[measured]]", "[[measure]]", "unknown key"),
        ('"right/01.png" = "', '"right/01.png" = "x', "SHA-256"),
        ("[files]", '[urls]\n"other.png" = "https://example.org"\n[files]', "not in"),
        ("[files]", '[urls]\n"left/01.png" = "ftp://example.org"\n[files]', "address"),
    ],
)
def test_wrong_descriptions_are_refused(tmp_path: Path, before: str, after: str, says: str) -> None:
    path = described(tmp_path, {}) / "small.toml"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    with pytest.raises(InputError, match=says):
        load_public_set(path)


def test_the_list_of_the_project(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fetch", "--catalogue", str(REPOSITORY / "datasets/public")]) == ExitCode.WELL
    listed = capsys.readouterr().out
    assert all(f"{name}: " in listed for name in ("caliper-board", "cylinder", "bumblebee2"))
    for one in public_sets(REPOSITORY / "datasets/public").values():
        assert one.path.stem == one.name
        assert one.sha256 and one.boards
    assert main(["fetch", "nobody", "--catalogue", str(REPOSITORY / "datasets/public")]) == ExitCode.BAD_INPUT


@pytest.mark.real
def test_files_kept_outside_have_their_hashes() -> None:
    """What is measured in the table of truth is what is described."""
    root = shared_data("")
    known = public_sets(REPOSITORY / "datasets/public")
    for name in ("bumblebee2", "trihedral-stereo", "caliper-board"):
        found = fetch_public_set(known[name], root)
        assert not found.missing and not found.fetched
        assert len(found.present) == len(known[name].sha256)
