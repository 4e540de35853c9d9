"""What a simulated projector of PJLink class 2 says over UDP: answers to searches, and notices of its changes."""

from __future__ import annotations

import contextlib
import threading
from types import TracebackType

from drivers.links.network import LOOPBACK, Address, UdpSocket
from drivers.pjlink import wire
from drivers.pjlink.wire import FaultsChanged, Found, InputChanged, LinkUp, PjLinkNotice, PowerChanged
from foundation.errors import DeviceRefused, LinkClosed, LinkTimeout
from sim.projectors.projector import SimulatedProjector

WATCH_S = 0.5
"""How often a served projector looks whether there is something to announce."""


class Announcer:
    """The notices of a `SimulatedProjector` of class 2: its start, then each change since somebody last looked."""

    def __init__(self, projector: SimulatedProjector) -> None:
        self._projector = projector
        self._sent: dict[type[PjLinkNotice], PjLinkNotice] = self._state()
        self._begun = False

    def news(self) -> tuple[PjLinkNotice, ...]:
        """Return the notices that are due now."""
        if self._projector.traits.pjlink_class < 2:
            return ()
        begun, self._begun = self._begun, True
        if not begun:
            return (LinkUp(self._projector.traits.mac),)
        state = self._state()
        news = tuple(notice for kind, notice in state.items() if self._sent.get(kind) != notice)
        self._sent |= state
        return news

    def _state(self) -> dict[type[PjLinkNotice], PjLinkNotice]:
        projector = self._projector
        state: list[PjLinkNotice] = [FaultsChanged(projector.faults()), PowerChanged(projector.power())]
        # In standby there is no input.
        with contextlib.suppress(DeviceRefused):
            state.append(InputChanged(projector.input()))
        return {type(notice): notice for notice in state}


class ProjectorDatagrams:
    """The UDP side of a simulated projector, in threads of its own: answers searches, sends notices; close it.

    An answer goes to the port from which the question came, not always to 4352: here both may share one computer.

    `controller`: to whom it sends notices, as a projector has it entered in its menu; None for nobody.
    """

    def __init__(self, projector: SimulatedProjector, port: int = 0, controller: Address | None = None) -> None:
        self._projector = projector
        self._controller = controller
        self._announcer = Announcer(projector)
        self._guard = threading.Lock()
        self._closing = threading.Event()
        self._socket = UdpSocket(port, LOOPBACK)
        self.address = self._socket.address
        """Host and port at which it hears searches."""
        self._threads = [
            threading.Thread(target=work, name=f"{name} {self.address[1]}", daemon=True)
            for work, name in ((self._answer, "answering searches at"), (self._watch, "announcing beside"))
        ]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> ProjectorDatagrams:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def announce(self) -> None:
        """Send the notices that are due now; nobody need call it, for it is done every half second."""
        with self._guard:
            if self._controller is None:
                return
            for notice in self._announcer.news():
                with contextlib.suppress(LinkClosed):
                    self._socket.send(wire.encode_datagram(notice), self._controller)

    def close(self) -> None:
        """Stop listening and wait for the threads; a second call does nothing."""
        if self._closing.is_set():
            return
        self._closing.set()
        # A datagram of our own is the one portable way to wake a thread that waits for one.
        with contextlib.suppress(LinkClosed):
            self._socket.send(b"", self.address)
        for thread in self._threads:
            thread.join()
        self._socket.close()

    def _answer(self) -> None:
        while not self._closing.is_set():
            try:
                datagram, sender = self._socket.receive(wire.IDLE_LIMIT_S)
            except LinkTimeout:
                continue
            except LinkClosed:
                return
            if wire.is_search(datagram) and self._projector.traits.pjlink_class >= 2:
                with contextlib.suppress(LinkClosed):
                    self._socket.send(wire.encode_datagram(Found(self._projector.traits.mac)), sender)

    def _watch(self) -> None:
        while not self._closing.wait(WATCH_S):
            self.announce()
