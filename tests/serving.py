"""A page's server that answers in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import TypeVar

from foundation.local_server import LocalServer

Server = TypeVar("Server", bound=LocalServer)


@contextmanager
def serving(server: Server) -> Generator[Server]:
    """Let a server answer, and end it."""
    with server:
        thread = threading.Thread(target=lambda: server.serve_forever(0.01))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
