"""`sim`: simulated devices on real cables, for trying the suite, or other software, without hardware."""

from __future__ import annotations

import threading
from typing import Annotated

import typer

from drivers import console
from drivers.console import EXIT_CODES

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="Simulated devices on loopback connections, until interrupted.\n\n" + EXIT_CODES,
)


def main() -> int:
    """Run `sim` and return its exit code."""
    return console.run(app)


@app.callback()
def _devices() -> None:  # pyright: ignore[reportUnusedFunction]  # typer calls it: one command alone would lose its name
    """Serve simulated devices on loopback connections, until interrupted."""


@app.command()
def projector(
    pjlink: Annotated[int, typer.Option(min=0, max=65535, help="TCP port for PJLink; 0 picks a free one.")],
    password: Annotated[str | None, typer.Option(help="PJLink password, at most 32 characters.")] = None,
) -> None:
    """Serve a simulated projector: standby, 30 s of warm-up, on, 60 s of cooling.

    Reads and writes no file. Prints the address it listens on, then serves until interrupted (Ctrl-C), which is its
    proper end: exit code 0. Exit code 3 when the port is taken.
    """
    from drivers.clock import SystemClock
    from drivers.errors import InputError
    from drivers.pjlink.wire import MAX_PASSWORD
    from sim.projector import SimulatedProjector, serve_pjlink

    if password is not None and not 1 <= len(password) <= MAX_PASSWORD:
        raise InputError(
            f"the password has {len(password)} characters; PJLink allows at least 1, at most {MAX_PASSWORD}"
        )
    with serve_pjlink(SimulatedProjector(SystemClock()), pjlink, password) as server:
        host, port = server.address
        print(f"PJLink projector at {host}:{port}", flush=True)
        _until_interrupted()


def _until_interrupted() -> None:
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print("stopped")
