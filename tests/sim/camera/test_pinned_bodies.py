"""Answers of all simulated bodies, and a series of the driver with them."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from io import BytesIO
from typing import Any

import pytest

from drivers.camera import ExposureSettings, capture
from drivers.ptp.codes import Operation
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, LinkClosed
from sim.camera.bodies import EOS_6D_MARK_II, EOS_550D, EOS_550D_AS_LISTED, TEST_BODY, EosModel
from sim.camera.eos import CARD, DCIM, SimulatedEos
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


def short(data: bytes | None) -> str:
    """Return bytes as hexadecimal digits, long ones with a digest."""
    if data is None:
        return "-"
    text = data.hex()
    return text if len(text) <= 48 else f"{text[:32]}…{len(data)} {hashlib.sha256(data).hexdigest()[:8]}"


def exchange(host: Host, code: int, *parameters: int, data: bytes | None = None) -> str:
    """Send a request; return request and answer as a line."""
    requests = f"{code:04x} {' '.join(f'{number:x}' for number in parameters)} {short(data)}"
    try:
        answer = host.ask(code, *parameters, data=data)
    except LinkClosed:
        return f"{requests} > closed"
    response = " ".join(f"{number:x}" for number in (answer.response.code, *answer.response.parameters))
    events = " ".join(f"{number.code:x}{number.parameters}" for number in host.eos.events())
    return f"{requests} > {response} | {short(answer.data)} | {events}"


def host_of(name: str) -> Host:
    body, own = BODIES[name]
    options: dict[str, Any] = {"auto_power_off_s": 0, **own}
    clock, film = SimulatedClock(), NumberedFilm(700)
    return Host(SimulatedEos(body, film, clock, **options), clock, film)


def opening(host: Host) -> list[str]:
    """Take control as initiators do."""
    return [
        exchange(host, Operation.CLOSE_SESSION),
        exchange(host, Operation.OPEN_SESSION, 1),
        exchange(host, Operation.EOS_SET_REMOTE_MODE, 1),
        exchange(host, Operation.EOS_SET_EVENT_MODE, 1),
    ]


@pytest.mark.parametrize("name", list(BODIES)[:3])
def test_answers_of_bodies_are_unchanged(name: str, pinned: Pinned) -> None:
    host = host_of(name)
    answers = [
        exchange(host, Operation.GET_DEVICE_INFO),
        exchange(host, Operation.GET_STORAGE_IDS),
        *opening(host),
    ]
    host.events()
    codes = [spec.code for spec in BODIES[name][0].properties] + [0x5001, 0xD303, 0xD402, 0xD406, 0xD407, 0x5010]
    for ask in (Operation.GET_DEVICE_PROP_DESC, Operation.GET_DEVICE_PROP_VALUE):
        answers += [exchange(host, ask, code) for code in codes[::6] + codes[-6:]]
    for ask in (Operation.EOS_GET_DEVICE_INFO_EX, Operation.EOS_GET_REMOTE_MODE, Operation.GET_DEVICE_INFO):
        answers.append(exchange(host, ask))
    for ask in (Operation.EOS_GET_STORAGE_INFO, Operation.GET_STORAGE_INFO, Operation.GET_NUM_OBJECTS):
        answers += [
            exchange(host, ask, store, 0, parent) for store in (CARD, 0, 0x20000) for parent in (0, 0xFFFFFFFF, DCIM)
        ]
    pinned(f"a body, {name}, of itself", "\n".join(answers).encode())


@pytest.mark.slow
@pytest.mark.parametrize("name", BODIES)
def test_series_of_the_driver_is_unchanged(name: str, pinned: Pinned) -> None:
    """Bytes, times and results of a series of our driver."""
    body, options = BODIES[name]
    used_options = {key: value for key, value in options.items() if key not in ("battery", "auto_power_off_s")}
    lab = Lab(body, 400_000 if name == "Test" else 600, **used_options)
    requests: list[str] = []
    answer = lab.eos.answer

    def noted(request: Any, data: bytes | None) -> Any:
        answers = answer(request, data)
        words = f"{request.code:x} {' '.join(f'{one:x}' for one in request.parameters)} {short(data)}"
        code, size = answers.response.code, len(answers.data or b"")
        requests.append(f"{lab.clock.monotonic():.3f} {words} {code:x} {size}")
        return answers

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
    pinned(f"a series that is taken with a body, {name}", {"asked": "\n".join(requests).encode(), "outcomes": outcomes})
