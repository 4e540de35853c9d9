"""What simulated projectors and their drivers say to each other, byte by byte, while lamps and faults change."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from drivers import pjlink
from drivers.display.jvc import JvcFlatField
from drivers.display.lightcrafter import LightCrafterCommand, eight_bits, encode_colour, parse_colour, ten_bits
from drivers.links.link import Link, Peer, PeerLink
from drivers.pjlink import PjLinkProjector, PjLinkRequest
from drivers.presenter import BLACK, WHITE, Colour
from drivers.projector import Power, Severity
from drivers.serial_projectors import LANGUAGES, benq, epson, nec, optoma
from drivers.serial_projectors.epson import EpsonOnNetwork
from drivers.serial_projectors.optoma import OptomaProjector
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError
from sim.projectors.jvc import JvcPeer
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import ProjectorTraits, Screen, SimulatedProjector
from sim.projectors.serial import PEERS, EpsonPeer, OptomaPeer
from tests.drivers.display.test_lightcrafter import Table
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


TRAITS = {"epson": ProjectorTraits(warm_up_s=20.0, lamp_hours=4321.5), "nec": ProjectorTraits(lamp_hours=77.9)}
MAKERS: dict[str, tuple[Callable[..., Any], Callable[[SimulatedProjector], Peer], ProjectorTraits]] = {
    **{
        language.maker: (language.projector, PEERS[name], TRAITS.get(name, ProjectorTraits()))
        for name, language in LANGUAGES.items()
    },
    "Epson on a network": (EpsonOnNetwork, partial(EpsonPeer, network=True), ProjectorTraits(cool_down_s=5.0)),
    "Optoma that is silent of its mute": (OptomaProjector, partial(OptomaPeer, answers_mute=False), ProjectorTraits()),
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
            answers = str([ask() for ask in asked if ask is not None])
        except DeviceError as error:
            answers = str(error)
        found.append(f"{deed}: {'; '.join(said)} = {answers}")
        said.clear()
        clock.sleep(2.0)
    lit = [device.power().name, device.lamps(), device.light()]
    pinned(f"a dialogue with a projector, {maker}", [found, str(lit)])


def test_commands_that_no_driver_sends_are_answered_as_before(pinned: Pinned) -> None:
    found: dict[str, list[str]] = {}
    words = {
        "BenQ": [
            *(b"\r*pow=?#\r", b"\r*POW=ON#\r", b"\r*modelname=?#\r", b"\r*3d=?#\r", b"*pow#\r", b"\r*ltim=?#\r"),
            b"\r\r",
        ],
        "Epson": [b"PWR?\r", b"PWR ON\r", b"PWR 01\r", b"SNO?\r", b"ERR?\r", b"XYZ?\r", b"MUTE?\r", b"\r", b"LAMP?\r"],
        "NEC": [bytes.fromhex(one) for one in ("008500000186", "0200000000 02", "00BF00000100C0", "038A000000 8D")],
        "Optoma": [b"~00124 1\r", b"~00150 1\r", b"~00108 1\r", b"~0000 1\r", b"~0100 1\r", b"~00999 1\r", b"hello\r"],
        "PJLink": [
            b"%%%s\r" % word
            for word in b"1POWR ?,2SNUM ?,2INNM ?31,1INPT 99,1XXXX ?,2FREZ 1,2RRES ?,2SVOL 1,2FILT ?,1INST ?,2INST ?,"
            b"1AVMT 20,1CLSS ?,3POWR ?".split(b",")
        ],
    }
    for maker, every in words.items():
        for power in (Power.STANDBY, Power.ON):
            peer = MAKERS[maker][1](SimulatedProjector(SimulatedClock(), power))
            greeting = peer.connect()
            answers = [f"{one!r} {peer.receive(one)!r} {peer.closed}" for one in every]
            found[f"{maker} {power.name}"] = [repr(greeting), *answers]
    pinned("commands to projectors", found)


def test_words_of_projectors_are_what_they_were(pinned: Pinned) -> None:
    chance = random.Random(1)

    def said(ask: Callable[..., Any], *given: Any) -> str:
        try:
            return str(ask(*given))
        except (DeviceError, ValueError) as error:
            return str(error)

    pieces = [bytes(chance.choice(b"\x00\x20\x80\xa2\x85\x8a\x01\x05\x7f\xff") for _ in range(n)) for n in range(3, 40)]
    errors = [bytes(9), *(bytes([0] * at + [bit] + [0] * (8 - at)) for at in range(9) for bit in (1, 2, 8, 16, 128))]
    texts = [
        "", "0", "1", "2", "3", "4", "31", "30", "11", "OK", "ERR1", "001000", "000002", "1234 1 5 0", "1920x1080", "-",
        "*", "6Z",
    ]  # fmt: skip
    names = ("power", "mute", "faults", "lamps", "input", "resolution", "input_resolution", "freeze", "class")
    lines = (
        b"PJLINK 0\r,PJLINK 1 abcd1234,PJLINK ERRA,PJLINK 2 x,%1POWR=OK,%2LKUP=00:11:22:33:44:55,%1POWR 1,%2SRCH,"
        b"%1ERST=000000,%1POWR=ERR4"
    ).split(b",")
    found = {
        "nec": [said(nec.take_reply, piece + bytes([sum(piece) & 255])) for piece in pieces[:12]],
        "errors": [said(nec.parse_errors, one) for one in errors],
        "running": [
            said(nec.parse_running, bytes([*head, on, cool, at]), off)
            for head in ([0] * 3,)
            for on in (0, 1)
            for cool in (0, 1)
            for at in (0, 1, 4, 5, 6)
            for off in (False, True)
        ],
        "nec bytes": [
            nec.encode_command(nec.NecCommand(3, 0x8A, b"ab")).hex(),
            nec.format_information("x", 7777).hex(),
            nec.format_basic_information(3, frozen=True).hex(),
        ],
        "running bytes": [
            nec.format_running(power).hex() for power in (Power.STANDBY, Power.ON, Power.WARMING, Power.COOLING)
        ],
        "epson": [said(epson.parse_power, one) for one in ("00", "01", "02", "03", "04", "05", "09", "x")]
        + [said(epson.parse_faults, one) for one in ("00", "01", "03", "0E 11", "zz")],
        "epson bytes": [
            epson.encode_welcome().hex(),
            epson.encode_get("A").hex(),
            epson.encode_set("A", "B").hex(),
            epson.encode_reply("x").hex(),
            said(epson.take_welcome, epson.encode_welcome(0x43)),
        ],
        "benq": [
            benq.encode_command("pow").hex(),
            benq.encode_answer("x").hex(),
            *(said(benq.value_of, "pow", one) for one in ("POW=ON", "Illegal format", "*POW=OFF#", "Block item", "x")),
        ],
        "optoma": [
            str((optoma.info_of_power(power), optoma.encode_message("INFO1").hex()))
            for power in (Power.ON, Power.STANDBY, Power.COOLING)
        ],
        "pjlink": {name: [said(getattr(pjlink, f"parse_{name}"), text) for text in texts] for name in names},
        "lines": [
            [
                said(pjlink.parse_greeting, line),
                said(pjlink.parse_reply, line),
                said(pjlink.parse_request, line),
                str(pjlink.is_search(line)),
                str(pjlink.replies_in(line + b"\r")),
                str(pjlink.is_notice_of_start(line)),
            ]
            for line in lines
        ],
        "inputs": [
            code for code in ("10", "11", "19", "59", "5A", "61", "60", "7", "1a") if pjlink.is_class_1_input(code)
        ],
        "digests": [
            pjlink.authentication_digest("498e4a67", "JBMIAProjectorLink"),
            pjlink.sha256_digest(bytes(16), bytes(range(16)), "x"),
        ],
        "request": pjlink.encode_request(PjLinkRequest("POWR", "?", 2, "ab")).hex(),
    }
    pinned("words of projectors", found)


def test_colours_of_displays_are_sent_as_they_were(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, said = SimulatedClock(), list[str]()
    screen = Screen(WHITE)
    peer = JvcPeer(screen)
    jvc = JvcFlatField(lambda: Overheard(PeerLink(peer), said, clock), clock=clock)
    shown: list[str] = []
    for colour in (Colour(255, 128, 10), BLACK, Colour(1, 2, 254)):
        jvc.show(colour)
        shown.append(str(screen.colour))
        clock.sleep(40)
    jvc.close()
    table, reports = Table(), list[str]()
    write, read = table.device.write, table.device.read

    def told(endpoint: int, data: bytes) -> None:
        reports.append(f"> {data.hex().rstrip('0')}")
        write(endpoint, data)

    def heard(endpoint: int, limit: int) -> bytes | None:
        data = read(endpoint, limit)
        reports.append(f"< {(data or b'').hex().rstrip('0')}")
        return data

    monkeypatch.setattr(table.device, "read", heard)
    monkeypatch.setattr(table.device, "write", told)
    presenter = table.presenter()
    for colour in (Colour(255, 128, 10), BLACK, Colour(1, 2, 254)):
        presenter.show(colour)
        presenter.verify(colour)
        shown.append(f"{table.screen.colour} {table.clock.monotonic():.3f}")
    presenter.close()
    bits = [[code, ten_bits(code), eight_bits(ten_bits(code))] for code in (0, 1, 2, 63, 64, 127, 128, 129, 254, 255)]
    back = str(parse_colour(encode_colour(Colour(3, 77, 255))))
    commands = {one.name: int(one) for one in LightCrafterCommand}
    pinned("colours of displays", [said, shown, reports, str(bits), back, commands])
