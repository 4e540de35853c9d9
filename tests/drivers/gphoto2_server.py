"""A simulated EOS in its own process, for an initiator that blocks the interpreter of its process.

``python -m tests.drivers.gphoto2_server`` reads port numbers. For each it prints the address of a body, then one line
per exposure, until the line ``end``, answered by ``ended``. Each body is a fork, because the imports take half a
second.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from dataclasses import asdict, replace
from datetime import datetime
from typing import BinaryIO

from drivers.camera import ExposureSettings
from foundation.clock import SystemClock
from sim.buses.ptp import serve_ptpip
from sim.camera.bodies import EOS_550D
from sim.camera.eos import SimulatedEos
from tests.contracts.camera import SeededFilm

FILM_BYTES = 1_200_000


class ReportedFilm(SeededFilm):
    """Prints the settings of each exposure."""

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        size = super().expose(settings, released_at, into)
        print(json.dumps(asdict(settings)), flush=True)
        return size


def _end(number: int, frame: object) -> None:
    sys.exit()


def serve(port: int) -> None:
    """Serve one body until SIGTERM comes."""
    signal.signal(signal.SIGTERM, _end)
    body = replace(EOS_550D, write_s=0.02)
    eos = SimulatedEos(body, ReportedFilm(FILM_BYTES), SystemClock(), auto_power_off_s=0)
    with serve_ptpip(eos, port) as server:
        host, number = server.address
        print(f"ptpip:{host}:{number}:{number}", flush=True)
        while True:
            signal.pause()


def main() -> None:
    """Serve one body after another until standard input ends."""
    pid = 0
    for line in sys.stdin:
        if line == "end\n":
            os.kill(pid, signal.SIGTERM)
            os.waitpid(pid, 0)
            print("ended", flush=True)
        elif not (pid := os.fork()):
            serve(int(line))


if __name__ == "__main__":
    main()
