"""Requests to the coach's page that no page of ours sends, for `fuzz.py`: in this process, without a network."""

from __future__ import annotations

import asyncio
import functools
import json
import random
import tempfile
from pathlib import Path
from typing import Any

import cv2

from fuzzing.mutations import mutated
from fuzzing.seeds import write_images
from rigkit.coach.guide import GuideOptions
from rigkit.coach.server import LOCAL, MAX_UPLOAD_BYTES, coach_app
from rigkit.core.boards import Board
from rigkit.workflows.capture.coach import open_coach
from rigkit.workflows.options.coach import CoachOptions

TOKEN = "s3cret-of-this-page"
HOST = "127.0.0.1:8137"
TOKENS = (
    TOKEN,
    TOKEN,
    TOKEN,
    TOKEN,
    "",
    TOKEN[:-1],
    TOKEN + "x",
    "caf\u00e9",
    "%00",
    "..",
    "x" * 5000,
    "\x00",
)
ACTIONS = (
    "look", "look", "take", "take", "photo", "undo",
    "frame0.jpg", "frame1.jpg", "frame-1.jpg", "frame" + "9" * 400 + ".jpg",
    "finish", "state", "", "frame.jpg", "../../etc/passwd", "..%2f..%2fetc",
    "look/", "LOOK", "%6cook", "x" * 5000, "caf\u00e9", "a\nb", "\x00", "frame.jpg/..",
)  # fmt: skip
SIZES = (
    None, None, None, "sizes=HALF,HALF", "sizes=HALF,HALF", "sizes=ALL", "sizes=", "sizes=1", "sizes=-1,1", "sizes=a,b",
    "sizes=\xb2", "sizes=" + "9" * 400, "sizes=0,ALL", "sizes=" + 300 * "0," + "ALL", "sizes", "x=1", "%zz", "\x00",
)  # fmt: skip
"""What is said of the pictures in a request; HALF and ALL are its true lengths."""
NETWORK = "192.168.7.9"
"""The address of this machine in a network, where others may ask too."""
METHODS = ("POST", "POST", "POST", "POST", "GET", "PUT", "DELETE", "HEAD", "OPTIONS", "PATCH", "FOO", "")
HOSTS = (HOST, HOST, HOST, NETWORK, "localhost:1",
         "[::1]:80", "evil.example", "127.0.0.1.evil.example", "", "[", "[::1",
         "a:b:c", "\xff", "127.0.0.1:99999999", "//", "@127.0.0.1", "127.0.0.1@evil.example")  # fmt: skip
ORIGINS = (f"http://{HOST}", f"http://{HOST}", f"http://{HOST}", None, "null", "http://evil.example", "", "[",
           "http://[", f"http://{HOST}/../x", f"http://user@{HOST}", "\xff")  # fmt: skip
LENGTHS = (None, None, None, None, "0", "-1", "abc", "9" * 30, "9" * 5000, str(MAX_UPLOAD_BYTES + 1), "1e9", "", "\xb2")
ANSWERS = {200, 400, 403, 404, 405, 413}
"""Anything else is a fault; 500 above all."""


@functools.cache
def _pictures() -> dict[str, bytes]:
    """Return good pictures by the ending of their files."""
    with tempfile.TemporaryDirectory() as folder:
        write_images(Path(folder))
        return {
            name: (Path(folder) / name).read_bytes() for name in ("image.png", "image.jpg", "deep.png", "image.webp")
        }


def run_case(seed: int, number: int) -> None:
    """Send three to six requests, of which some are as they should be; raises AssertionError for an answer that is not
    one of those that a page may get, for one that only the page's own may get, and for files that are no frames."""
    rng = random.Random(f"{seed}/requests/{number}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "session"
        guide = GuideOptions(boards=(Board("small", 5, 4, 30.0, 30.0),))
        cameras = rng.choice((1, 1, 2))
        coach = open_coach(CoachOptions(folder=folder, boards=("5x4x30",), guide=guide, cameras=cameras))
        hosts = rng.choice((LOCAL, (NETWORK, *LOCAL)))
        app = coach_app(coach, TOKEN, hosts, camera=rng.choice(("page", "server")))
        for _ in range(rng.randrange(3, 7)):
            _checked(app, rng)
        outside = [path for path in Path(name).iterdir() if path != folder]
        assert not outside, f"written outside of the session: {outside}"
        for path in (path for path in (folder / "images").rglob("*") if path.is_file()):
            whole = cv2.imread(str(path)) if path.suffix == ".png" else path.suffix == ".dropped" or None
            assert whole is not None, f"a frame that is none was kept: {path.name}"


def _checked(app: Any, rng: random.Random) -> None:
    token, action, method = rng.choice(TOKENS), rng.choice(ACTIONS), rng.choice(METHODS)
    host, origin, length = rng.choice(HOSTS), rng.choice(ORIGINS), rng.choice(LENGTHS)
    name = rng.choice(sorted(_pictures()))
    good = _pictures()[name]
    body = rng.choice((good, good, mutated(good, name, rng), mutated(good, name, rng), b"", rng.randbytes(300), b"{}"))
    if rng.random() < 0.02:
        body = bytes(MAX_UPLOAD_BYTES + 10)
    if rng.random() < 0.5:
        # Only what is sent is wrong.
        token, method, host, origin, length = TOKEN, "POST", HOST, f"http://{HOST}", None
    sizes = rng.choice(SIZES)
    if sizes is not None and "HALF" in sizes:
        body *= 2
    query = (sizes or "").replace("HALF", str(len(body) // 2)).replace("ALL", str(len(body)))
    headers = {"host": host, "origin": origin, "content-length": length}
    shown = f"{method} /{token[:60]}/{action[:60]}?{query[:60]} {json.dumps(headers)[:200]} and {len(body)} bytes"
    status, answer = asyncio.run(
        _answered(app, method, (f"/{token}/{action}", query), headers, body, rng.randrange(1, 4))
    )
    assert status in ANSWERS, f"{shown}: {status}"
    assert status != 200 or token == TOKEN, f"{shown}: answered without the token"
    if status == 200 and method == "POST":
        assert (host, origin) == (HOST, f"http://{HOST}") or _local(host, origin), f"{shown}: answered a stranger"
        json.loads(answer, parse_constant=_no_constant)


def _local(host: str, origin: str | None) -> bool:
    return origin is not None and origin.split("//")[-1].split("/")[0].split("@")[-1] == host


def _no_constant(word: str) -> float:
    raise AssertionError(f"an answer with {word}")


async def _answered(
    app: Any, method: str, address: tuple[str, str], headers: dict[str, str | None], body: bytes, parts: int
) -> tuple[int, bytes]:
    """Return status and body of what the application answers to one request to (path, query), whose body comes in
    parts."""
    path, query = address
    given = [(k.encode(), v.encode("utf-8", "surrogateescape")) for k, v in headers.items() if v is not None]
    scope = {
        "type": "http", "http_version": "1.1", "method": method, "path": path, "root_path": "", "scheme": "http",
        "raw_path": path.encode("utf-8", "surrogateescape"), "query_string": query.encode("utf-8", "surrogateescape"),
        "headers": given,
        "client": ("127.0.0.1", 5000), "server": ("127.0.0.1", 8137),
    }  # fmt: skip
    step = max(1, -(-len(body) // parts))
    chunks = [body[k : k + step] for k in range(0, len(body), step)] or [b""]
    sent: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        if not chunks:
            return {"type": "http.disconnect"}
        chunk = chunks.pop(0)
        return {"type": "http.request", "body": chunk, "more_body": bool(chunks)}

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    await app(scope, receive, send)
    assert sent and sent[0]["type"] == "http.response.start", "no answer"
    return int(sent[0]["status"]), b"".join(m.get("body", b"") for m in sent[1:])
