"""A simulated EOS with its driver, optionally with faults, for the tests of the EOS driver."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

from drivers.camera import CapturedFrame, capture
from drivers.canon import CanonEos
from drivers.links.usb import UsbPipes, open_usb
from drivers.ptp.protocol import Responder, Transport
from drivers.ptp.usb import UsbTransport
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, DeviceFault, DeviceRefused
from sim.buses.usb import PtpUsbDevice, SimulatedBus
from sim.camera.bodies import EOS_550D, EosModel
from sim.camera.eos import SimulatedEos
from tests.contracts.camera import SeededFilm


class Lab:
    """A simulated EOS on cables in memory; `device`, `pipes` and `cable` may be replaced by faulty ones."""

    def __init__(self, body: EosModel = EOS_550D, film_bytes: int = 600, **options: Any) -> None:
        all_options: dict[str, Any] = {"auto_power_off_s": 0, **options}
        self.clock = SimulatedClock()
        self.film = SeededFilm(film_bytes)
        self.eos = SimulatedEos(body, self.film, self.clock, **all_options)
        self.device: Responder = self.eos
        self.pipes: Callable[[UsbPipes], UsbPipes] = lambda pipes: pipes
        self.cable: Callable[[Transport], Transport] = lambda transport: transport
        self.openings = 0
        self.camera = CanonEos(self.open, self.clock)

    def open(self) -> Transport:
        self.openings += 1
        pipes = open_usb(backend=SimulatedBus(PtpUsbDevice(self.device)))
        return self.cable(UsbTransport(self.pipes(pipes), self.clock))

    def take(self, attempts: int = 3) -> CapturedFrame:
        """Take a frame as the sequencer does; it must be the last exposed frame."""
        for remaining_attempts in reversed(range(attempts)):
            into = io.BytesIO()
            try:
                captured = capture(self.camera, into)
            except DeviceError as error:
                if not remaining_attempts or isinstance(error, DeviceRefused | DeviceFault):
                    raise
                continue
            assert into.getvalue() == self.film.frames[-1]
            assert captured.size == len(self.film.frames[-1])
            return captured
        raise AssertionError

    def press(self) -> None:
        """Release the shutter on the camera itself."""
        self.eos._full_press()
        self.clock.sleep(5)
        assert not self.eos.busy

    def waiting(self) -> int:
        """Return the number of objects in the body's memory."""
        assert not self.eos.busy
        return len(self.eos._memory)

    def pull(self) -> None:
        """Unplug the cable and plug it in again."""
        self.camera._drop_connection(None)

    def download(self) -> bytes:
        """Return the bytes of the last exposed frame."""
        into = io.BytesIO()
        self.camera.download(into)
        return into.getvalue()
