"""Run the server of a page in a separate thread."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import TypeVar

from foundation.local_server import LocalServer

Server = TypeVar("Server", bound=LocalServer)


@contextmanager
def serving(server: Server) -> Generator[Server]:
    """Run a server during the block."""
    with server:
        thread = threading.Thread(target=lambda: server.serve_forever(0.01))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
