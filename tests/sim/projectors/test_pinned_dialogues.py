"""What simulated projectors and their drivers say to each other, byte by byte, while lamps and faults change."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from drivers.links.link import Link, Peer, PeerLink
from drivers.pjlink import PjLinkProjector
from drivers.projector import Severity
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import ProjectorTraits, SimulatedProjector
from tests.pinned import Pinned


class Overheard:
    """A link of which every byte is noted."""

    def __init__(self, link: Link, said: list[str], clock: SimulatedClock) -> None:
        self._link, self._said, self._clock = link, said, clock

    def write(self, data: bytes, timeout: float) -> None:
        self._said.append(f"{self._clock.monotonic():.2f} > {data!r}")
        self._link.write(data, timeout)

    def read(self, limit: int, timeout: float) -> bytes:
        data = self._link.read(limit, timeout)
        self._said.append(f"< {data!r}")
        return data

    def close(self) -> None:
        self._link.close()


MAKERS: dict[str, tuple[Callable[..., Any], Callable[[SimulatedProjector], Peer], ProjectorTraits]] = {
    "PJLink": (PjLinkProjector, PjLinkPeer, ProjectorTraits()),
    "PJLink of class 1": (PjLinkProjector, PjLinkPeer, ProjectorTraits(pjlink_class=1, filter_hours=None)),
    "PJLink with a password": (
        partial(PjLinkProjector, password="secret"),
        partial(PjLinkPeer, password="secret", seed="498e4a67"),
        ProjectorTraits(),
    ),
}
QUESTIONS = ("identity", "power", "muted", "faults", "lamps", "picture_fault", "input", "input_resolution", "frozen")


@pytest.mark.parametrize("maker", MAKERS)
def test_a_dialogue_goes_as_it_went(maker: str, pinned: Pinned) -> None:
    driver, peer_of, traits = MAKERS[maker]
    clock, said, chance = SimulatedClock(), list[str](), random.Random(maker)
    device = SimulatedProjector(clock, traits=traits)
    peer = peer_of(device)
    projector = driver(lambda: Overheard(PeerLink(peer), said, clock), clock=clock)
    deeds: dict[str, Callable[[], object]] = {
        "on": projector.switch_on,
        "off": projector.switch_off,
        "mute": lambda: projector.set_muted(True),
        "unmute": lambda: projector.set_muted(False),
        "warning": lambda: device.break_part("filter", Severity.WARNING),
        "error": lambda: device.break_part("lamp", Severity.ERROR),
        "fan": lambda: device.break_part("fan", Severity.ERROR),
        "repair": device.repair,
        "freeze": lambda: device.set_frozen(True),
        "other-input": lambda: device.set_input("11"),
        "close": projector.close,
    }
    order = [
        "on", "wait", "mute", "warning", "unmute", "freeze", "other-input", "off", "error", "repair", "wait", "off",
    ]  # fmt: skip
    found: list[str] = []
    for deed in [*order, *chance.choices([*deeds, "wait"], k=9)]:
        try:
            if deed == "wait":
                clock.sleep(chance.choice((1.0, 12.0, 40.0, 100.0)))
            else:
                deeds[deed]()
            asked = [getattr(projector, name, None) for name in (*QUESTIONS[1:3], chance.choice(QUESTIONS))]
            for ask in asked:
                if ask is not None:
                    ask()
        except DeviceError:
            found.append("failed")
        found.append(f"{deed}: {'; '.join(said)}")
        said.clear()
        clock.sleep(2.0)
    lit = [device.lamps(), device.light()]
    pinned(f"a dialogue with a projector, {maker}", {"said": "\n".join(found).encode(), "lit": lit})
