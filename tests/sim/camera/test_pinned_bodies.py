"""What every simulated body answers, byte by byte, in long conversations that were drawn once by chance."""

from __future__ import annotations

import hashlib
import random
from dataclasses import replace
from io import BytesIO
from typing import Any

import pytest

from drivers import canon
from drivers.camera import ExposureSettings, capture
from drivers.canon import EosState, PropertySetting, number_value
from drivers.ptp.codes import AeMode, CaptureDestination, Operation, Property
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, InputError, LinkClosed
from sim.camera.bodies import EOS_6D_MARK_II, EOS_550D, EOS_550D_AS_LISTED, TEST_BODY, EosModel
from sim.camera.eos import CARD, DCIM, FOLDER, SimulatedEos
from tests.drivers.eos_lab import Lab
from tests.pinned import Pinned
from tests.sim.camera.test_eos import Host, NumberedFilm

BODIES: dict[str, tuple[EosModel, dict[str, Any]]] = {
    "EOS 550D": (EOS_550D, {}),
    "EOS 550D as listed": (EOS_550D_AS_LISTED, {"card_bytes": None, "battery": 0.52}),
    "EOS 6D Mark II": (EOS_6D_MARK_II, {"card_bytes": 90 << 20, "auto_power_off_s": 60}),
    "EOS 6D Mark II of wide records": (
        replace(EOS_6D_MARK_II, wide_objects=True),
        {"without": (Operation.EOS_REMOTE_RELEASE_ON,)},
    ),
    "Test": (TEST_BODY, {"card_bytes": 3 << 20, "battery": 4.5 / 440, "forgetful": True, "auto_power_off_s": None}),
}


SETTINGS = (
    *(ExposureSettings(100, 8.0, 0.5), ExposureSettings(110, 8.0, 0.4), ExposureSettings(6400, 1.8, 30.0)),
    *(ExposureSettings(200, None, 1 / 60), ExposureSettings(400, 5.6, 31.0), ExposureSettings(200, 22.0, 1 / 8000)),
)
WANTED = (0.5, 0.3, 0.29, 1 / 60, 1 / 61, 30, 31, 8.0, 5.6, 5.65, 100, 125, 130, "1/60", "bulb", "0.5", "x", "1/0", 1e9)
DONE = {
    "set": 8, "on": 6, "off": 5, "wait": 9, "event": 8, "release": 2, "get": 3, "part": 3, "delete": 2, "done": 3,
    "list": 3, "value": 3, "room": 3, "hand": 3, "keep": 2, "reset": 1,
}  # fmt: skip
"""How often each thing is done to a body."""


def short(data: bytes | None) -> str:
    """Return bytes as hex, the end of many by their digest."""
    if data is None:
        return "-"
    text = data.hex()
    return text if len(text) <= 48 else f"{text[:32]}…{len(data)} {hashlib.sha256(data).hexdigest()[:8]}"


def told(host: Host, code: int, *parameters: int, data: bytes | None = None) -> str:
    """Ask and return question and answer as a line."""
    asked = f"{code:04x} {' '.join(f'{one:x}' for one in parameters)} {short(data)}"
    try:
        answer = host.ask(code, *parameters, data=data)
    except LinkClosed:
        return f"{asked} > closed"
    response = " ".join(f"{one:x}" for one in (answer.response.code, *answer.response.parameters))
    events = " ".join(f"{one.code:x}{one.parameters}" for one in host.eos.events())
    return f"{asked} > {response} | {short(answer.data)} | {events}"


def host_of(name: str) -> Host:
    body, own = BODIES[name]
    given: dict[str, Any] = {"auto_power_off_s": 0, **own}
    clock, film = SimulatedClock(), NumberedFilm(700)
    return Host(SimulatedEos(body, film, clock, **given), clock, film)


def opening(host: Host) -> list[str]:
    """Take control as hosts do."""
    return [
        told(host, Operation.CLOSE_SESSION),
        told(host, Operation.OPEN_SESSION, 1),
        told(host, Operation.EOS_SET_REMOTE_MODE, 1),
        told(host, Operation.EOS_SET_EVENT_MODE, 1),
    ]


@pytest.mark.parametrize("name", list(BODIES)[:3])
def test_a_body_says_of_itself_what_it_said(name: str, pinned: Pinned) -> None:
    host = host_of(name)
    found = [told(host, Operation.GET_DEVICE_INFO), told(host, Operation.GET_STORAGE_IDS), *opening(host)]
    host.events()
    codes = [spec.code for spec in BODIES[name][0].properties] + [0x5001, 0xD303, 0xD402, 0xD406, 0xD407, 0x5010]
    for ask in (Operation.GET_DEVICE_PROP_DESC, Operation.GET_DEVICE_PROP_VALUE):
        found += [told(host, ask, code) for code in codes[::6] + codes[-6:]]
    for ask in (Operation.EOS_GET_DEVICE_INFO_EX, Operation.EOS_GET_REMOTE_MODE, Operation.GET_DEVICE_INFO):
        found.append(told(host, ask))
    for ask in (Operation.EOS_GET_STORAGE_INFO, Operation.GET_STORAGE_INFO, Operation.GET_NUM_OBJECTS):
        found += [told(host, ask, store, 0, parent) for store in (CARD, 0, 0x20000) for parent in (0, 0xFFFFFFFF, DCIM)]
    pinned(f"a body, {name}, of itself", "\n".join(found).encode())


def step(host: Host, chance: random.Random, handles: list[int]) -> str:
    """Do one thing to a body, and return what it said."""
    body = host.eos
    spec = chance.choice(BODIES[chance.choice(list(BODIES))][0].properties)
    choices = [*spec.choices, chance.randrange(256)]
    handle = chance.choice([*handles, CARD, DCIM, FOLDER, 0, 0xFFFFFFFF])
    part = chance.choice((0, 1, 100, 699, 700, 701, 0x100000))
    value = number_value(chance.choice(choices))
    if spec.formats:
        value = chance.choice(spec.formats).encode() if chance.random() < 0.9 else b"\1\0\0\0"
    what = chance.choices(list(DONE), list(DONE.values()))[0]
    match what:
        case "set" if chance.random() < 0.4:
            model = chance.choice(list(BODIES.values()))[0]
            shutter, aperture = chance.choice(model.shutter_codes), chance.choice(model.aperture_codes)
            of = chance.choice(((Property.EOS_SHUTTER_SPEED, shutter), (Property.EOS_APERTURE, aperture)))
            setting = PropertySetting(of[0], number_value(of[1]))
            return told(host, Operation.EOS_SET_DEVICE_PROP_VALUE_EX, data=setting.encode())
        case "set":
            return told(host, Operation.EOS_SET_DEVICE_PROP_VALUE_EX, data=PropertySetting(spec.code, value).encode())
        case "on":
            return told(
                host, Operation.EOS_REMOTE_RELEASE_ON, chance.choice((3, 3, 3, 1, 2, 0, 4)), chance.randrange(2)
            )
        case "off":
            return told(host, Operation.EOS_REMOTE_RELEASE_OFF, chance.choice((1, 2, 3, 3)))
        case "wait":
            seconds = chance.choice((0.05, 0.2, 0.5, 1.0, 3.0, 11.0, 33.0))
            host.clock.sleep(seconds)
            return f"{seconds:g} s later: busy {body.busy}, asleep {body.asleep}"
        case "event":
            return told(host, Operation.EOS_GET_EVENT)
        case "release":
            return told(host, Operation.EOS_REMOTE_RELEASE)
        case "get":
            some = (Operation.GET_OBJECT, Operation.EOS_GET_OBJECT, Operation.GET_OBJECT_INFO, Operation.GET_THUMB)
            return told(host, chance.choice(some), handle)
        case "part":
            some = (Operation.GET_PARTIAL_OBJECT, Operation.EOS_GET_PARTIAL_OBJECT)
            return told(host, chance.choice(some), handle, chance.choice((0, 1, 699, 700)), part)
        case "delete":
            return told(host, chance.choice((Operation.DELETE_OBJECT, Operation.EOS_DELETE_OBJECT)), handle)
        case "done":
            return told(host, chance.choice((Operation.EOS_TRANSFER_COMPLETE, Operation.EOS_CANCEL_TRANSFER)), handle)
        case "list":
            some = (Operation.GET_NUM_OBJECTS, Operation.GET_OBJECT_HANDLES, Operation.EOS_GET_OBJECT_INFO_EX)
            second = chance.choice((0, 0x3001, 0xB103, FOLDER, DCIM, 0xFFFFFFFF))
            return told(host, chance.choice(some), chance.choice((CARD, 0xFFFFFFFF)), second, handle)
        case "value":
            some = (Operation.EOS_REQUEST_DEVICE_PROP_VALUE, Operation.GET_DEVICE_PROP_VALUE)
            return told(host, chance.choice(some), spec.code)
        case "room":
            return told(host, Operation.EOS_PC_HDD_CAPACITY, chance.choice((0, 1, 0x0FFFFFFF)), 0x1000, 1)
        case "hand":
            hands = {
                "dial": lambda: body.turn_dial(chance.choice(list(AeMode)[:8])),
                "focus": lambda: body.switch_focus((chance.random() < 0.3, chance.random())[0]),
                "lockup": lambda: body.switch_mirror_lockup(chance.random() < 0.2),
                "power": lambda: body.set_menu(Property.EOS_AUTO_POWER_OFF, chance.choice((0, 30, 240))),
                "no card": body.remove_card,
                "manual": lambda: body.turn_dial(AeMode.MANUAL),
                "wake": body.wake,
            }
            name = chance.choice(list(hands))
            hands[name]()
            return name
        case "keep":
            return told(host, Operation.EOS_KEEP_DEVICE_ON)
        case _:
            return told(host, chance.choice((Operation.EOS_RESET_TRANSFER, Operation.EOS_AF_CANCEL)))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(BODIES)[1::2] + list(BODIES)[4:])
def test_a_body_answers_what_it_answered(name: str, pinned: Pinned) -> None:
    host, chance = host_of(name), random.Random(name)
    destination = PropertySetting(Property.EOS_CAPTURE_DESTINATION, number_value(CaptureDestination.HOST)).encode()
    found = opening(host)
    for number in range(210):
        if host.eos.asleep and chance.random() < 0.5:
            host.eos.wake()
        if number % 30 == 0 or "> 2003" in found[-1]:
            # Into the host's memory, the card, and both.
            found += [*opening(host), told(host, Operation.EOS_PC_HDD_CAPACITY, 0x0FFFFFFF, 0x1000, 1)]
            found.append(told(host, Operation.EOS_SET_DEVICE_PROP_VALUE_EX, data=destination))
            host.eos.turn_dial(AeMode.MANUAL)
        handles = [*host.eos._memory, *host.eos._on_card()]  # what it may be asked
        found.append(step(host, chance, handles))
        if number % 5 == 4:
            found.append(told(host, Operation.EOS_GET_EVENT))
    exposed = [settings for settings, _ in host.film.exposures]
    pinned(f"a conversation with a body, {name}", {"said": "\n".join(found).encode(), "exposed": exposed})


@pytest.mark.parametrize("name", list(BODIES)[:3])
def test_the_driver_plans_what_it_planned(name: str, pinned: Pinned) -> None:
    """Every exposure of a body, set or refused, in two states of its dials."""
    found: dict[str, Any] = {}
    for mode in (AeMode.MANUAL, AeMode.APERTURE_PRIORITY, AeMode.BULB):
        host = host_of(name)
        host.eos.turn_dial(mode)
        if mode is AeMode.BULB:
            host.eos.switch_focus(automatic=True)
            host.eos.switch_mirror_lockup(True)
            host.eos.set_menu(Property.EOS_AEB, 8)
        opening(host)
        state = EosState()
        state.take(host.events())
        plans: dict[str, Any] = {}
        for settings in SETTINGS:
            title = f"{settings.iso} {settings.aperture} {settings.shutter_s:g}"
            try:
                plan = canon.plan(state, settings)
                plans[title] = b"".join(plan.values())
            except DeviceError:
                plans[title] = {"refused": 1}
        functions = [
            canon.custom_functions(one) for code, one in state.values.items() if code == Property.EOS_CUSTOM_FUNCTIONS
        ]
        found[mode.name] = [
            plans, len(canon.problems(state)), canon.shutter_speeds(state), canon.host_destination(state), functions,
            canon.battery_level(state),
        ]  # fmt: skip
    pinned(f"exposures that a body is set to, {name}", found)


def test_scales_are_what_they_were(pinned: Pinned) -> None:
    found: dict[str, Any] = {}
    for scale in (canon.SHUTTER, canon.APERTURE, canon.ISO):
        values: list[float] = []
        for code in range(256):
            try:
                values += [code, scale.value(code)]
            except (InputError, DeviceError, KeyError, ValueError):
                continue
        codes: dict[str, int] = {}
        for wanted in WANTED:
            try:
                codes[str(wanted)] = scale.code(wanted)
            except (InputError, DeviceError):
                codes[str(wanted)] = -1
        found[scale.name] = {"values": values, "codes": list(codes.values())}
    pinned("scales of a camera", found)


@pytest.mark.slow
@pytest.mark.parametrize("name", BODIES)
def test_the_driver_takes_what_it_took(name: str, pinned: Pinned) -> None:
    """A series by our own driver: what goes over the cable, when, and what comes of it."""
    body, given = BODIES[name]
    kept = {key: value for key, value in given.items() if key not in ("battery", "auto_power_off_s")}
    lab = Lab(body, 400_000 if name == "Test" else 600, **kept)
    asked: list[str] = []
    answer = lab.eos.answer

    def noted(request: Any, data: bytes | None) -> Any:
        found = answer(request, data)
        words = f"{request.code:x} {' '.join(f'{one:x}' for one in request.parameters)} {short(data)}"
        code, size = found.response.code, len(found.data or b"")
        asked.append(f"{lab.clock.monotonic():.3f} {words} {code:x} {size}")
        return found

    lab.eos.answer = noted  # to listen  # pyrefly: ignore[method-assign]
    outcomes: list[Any] = []
    for settings in (ExposureSettings(200, 8.0, 0.5), ExposureSettings(400, 5.6, 4.0)):
        try:
            lab.camera.configure(settings)
            for _ in range(2):
                into = BytesIO()
                frame = capture(lab.camera, into)
                outcomes.append([frame, into.getvalue()])
            outcomes.append([lab.camera.supplies(), lab.camera.shutter_speeds()[:3]])
        except DeviceError:
            outcomes.append({"refused": 1})
    lab.camera.close()
    pinned(f"a series that is taken with a body, {name}", {"asked": "\n".join(asked).encode(), "outcomes": outcomes})
