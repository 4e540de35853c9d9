"""A simulated EOS with the driver before it, in trouble if wanted: what the tests of the EOS driver play with."""

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
    """A simulated EOS on cables of memory: `device` and `pipes` may be put in trouble before the camera is used."""

    def __init__(self, body: EosModel = EOS_550D, film_bytes: int = 600, **given: Any) -> None:
        kind: dict[str, Any] = {"auto_power_off_s": 0, **given}
        self.clock = SimulatedClock()
        self.film = SeededFilm(film_bytes)
        self.eos = SimulatedEos(body, self.film, self.clock, **kind)
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
        """Take a frame as the sequencer does, and see that it is the one that was exposed last."""
        for left in reversed(range(attempts)):
            into = io.BytesIO()
            try:
                captured = capture(self.camera, into)
            except DeviceError as error:
                if not left or isinstance(error, DeviceRefused | DeviceFault):
                    raise
                continue
            assert into.getvalue() == self.film.frames[-1]
            assert captured.size == len(self.film.frames[-1])
            return captured
        raise AssertionError

    def press(self) -> None:
        """Press the release on the camera itself, and let the frame come."""
        self.eos._full_press()
        self.clock.sleep(5)
        assert not self.eos.busy

    def waiting(self) -> int:
        """Return how many objects wait in the body's memory now."""
        assert not self.eos.busy
        return len(self.eos._memory)

    def pull(self) -> None:
        """Pull the cable out, and put it back."""
        self.camera._drop_connection(None)

    def download(self) -> bytes:
        """Return what the camera writes of the frame exposed last."""
        into = io.BytesIO()
        self.camera.download(into)
        return into.getvalue()
