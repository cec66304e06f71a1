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
