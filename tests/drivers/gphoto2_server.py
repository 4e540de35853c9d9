"""A simulated EOS in a process of its own, for an initiator that keeps the interpreter of its process to itself.

``python -m tests.drivers.gphoto2_server PORT MODE`` prints its address, then a line for each exposure; it ends when
its standard input does.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, replace
from datetime import datetime
from typing import BinaryIO

from drivers.camera import ExposureSettings
from drivers.ptp.codes import AeMode
from foundation.clock import SystemClock
from sim.buses.ptp import serve_ptpip
from sim.camera.bodies import EOS_550D
from sim.camera.eos import SimulatedEos
from tests.contracts.camera import SeededFilm

FILM_BYTES = 3_000_000


class ReportedFilm(SeededFilm):
    """Tells on standard output how it was exposed."""

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        size = super().expose(settings, released_at, into)
        print(json.dumps(asdict(settings)), flush=True)
        return size


def main() -> None:
    """Serve until standard input ends."""
    port, mode = sys.argv[1:]
    body = replace(EOS_550D, write_s=0.02)
    if mode == "no contacts":
        body = replace(body, aperture_codes=())
    eos = SimulatedEos(body, ReportedFilm(FILM_BYTES), SystemClock(), auto_power_off_s=0)
    if mode == "unprepared":
        eos.turn_dial(AeMode.APERTURE_PRIORITY)
        eos.switch_focus(automatic=True)
    with serve_ptpip(eos, int(port)) as server:
        host, number = server.address
        print(f"ptpip:{host}:{number}:{number}", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
