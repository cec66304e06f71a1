"""A coach's page, served as long as a test runs."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from rigkit.coach.coach import Coach
from rigkit.coach.server import coach_app


@pytest.fixture
def serve() -> Iterator[Callable[[Coach, tuple[str, ...]], int]]:
    """Serve a coach under some names, with the token "secret", and return the port."""
    uvicorn = pytest.importorskip("uvicorn")
    running = []

    def start(coach: Coach, hosts: tuple[str, ...]) -> int:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = int(free.getsockname()[1])
        app = coach_app(coach, "secret", hosts)
        server = uvicorn.Server(uvicorn.Config(app, host="127.0.0.1", port=port, log_level="error"))
        thread = threading.Thread(target=server.run, daemon=True)
        thread.start()
        running.append((server, thread))
        while not server.started:
            time.sleep(0.02)
        return port

    yield start
    for server, thread in running:
        server.should_exit = True
        thread.join(10.0)


@pytest.fixture(autouse=True)
def fewer_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """A guide plans anew after every frame: here among a third of the poses. How well it chooses is for
    tests/planning."""
    monkeypatch.setattr("rigkit.planning.candidates.CANDIDATES_DRAWN", 800)
    monkeypatch.setattr("rigkit.planning.candidates.CANDIDATES_KEPT", 300)
