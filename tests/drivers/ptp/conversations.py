"""Conversations of a host with an EOS body, transaction by transaction.

Requests and response codes were recorded from a host with an EOS 60D: two sessions in aperture priority, the card
removed between them. The simulated EOS 550D answers the same requests. The full recording is used if it is present.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TypedDict

from drivers.ptp.codes import AeMode, DriveMode, Operation, Property
from drivers.ptp.protocol import Cursor, DevicePropDesc, PtpRequest, read_value
from foundation.clock import SimulatedClock
from sim.camera.bodies import EOS_550D
from sim.camera.eos import SimulatedEos
from tests.contracts.camera import SeededFilm
from tests.data_files import available


class Recorded(TypedDict):
    """One transaction; numbers and bytes as hex."""

    code: str
    tid: int
    params: list[int]
    data: str | None
    dir: str | None
    rc: str
    rparams: list[int]


# Operation and parameters | what the host sends, or "in" where the body sends | response; all numbers in hexadecimal.
_OPENING = """
1002 1              | -                        | 2001
1001                | in                       | 2001
9114 1              | -                        | 2001
9114 1              | -                        | 2001
9115 1              | -                        | 2001
9116                | in                       | 2001
9116                | in                       | 2001
9127 d115           | -                        | 2001
9127 d1d0           | -                        | 2001
9127 d1d1           | -                        | 2001
9127 d1af           | -                        | 2001
9108                | in                       | 2001
9116                | in                       | 2001
9116                | in                       | 2001
9110                | 0c0000001cd1000004000000 | 2001
911a 4ffffff 1000 1 | -                        | 2001
1001                | in                       | 2001
9101                | in                       | 2001
9102 {store}        | in                       | 2001
9116                | in                       | 2001
9116                | in                       | 2001
9116                | in                       | 2001
1014 5001           | in                       | 2001
1014 d402           | in                       | 2001
1014 d407           | in                       | 2001
1014 d406           | in                       | 2001
1014 d303           | in                       | 2001
1014 5001           | in                       | 2001
9116                | in                       | 2001
9110                | 0c00000001d1000024000000 | 2019
9116                | in                       | 2001
"""
_WITH_CARD = (
    _OPENING.format(store="20001")
    + """
9110                | 0c0000001cd1000002000000 | 2001
9116                | in                       | 2001
9116                | in                       | 2001
9114 0              | -                        | 2001
9115 0              | -                        | 2001
1003                | -                        | 2001
"""
)
_WITHOUT_CARD = (
    _OPENING.format(store="20000")
    + """
9110                | 0c0000001cd1000001000000 | 2019
1003                | -                        | 2001
"""
)


_PROPERTIES = """
d105 d108 d106 d107 d109 d10a d10b d10c d10d d10e d10f d11b d114 d116 d119 d11a d110 d115 d101 d102 d103 d104 d11d d111
d112 d113 d120 d122 d150 d151 d152 d153 d154 d155 d160 d161 d162 d170 d171 d172 d11c d1a0 d1a1 d1a2 d1a5 d1a8 d1ab d1b0
d1b1 d1b2 d1b3 d1b4 d1b5 d1b6 d1a9 d145 d1ac d1ad d1ae d11e d11f d1af d1d0 d1d1 d1d9 d1ba d1be d1bc d1b8 d1d3 d1d8 d17f
d1b7 d1b9 d1db d1dc d1df d1bd d1c1 d1c0 d1bf d1c4 d1c2 d1c5 d194 d198 d1c7
"""
# Properties of the recorded EOS 60D, in its order.
EOS_60D_PROPERTIES = tuple(int(code, 16) for code in _PROPERTIES.split())


def transcript() -> list[Recorded]:
    """Return both sessions of the EOS 60D, without the data from the body."""
    return [*_session(_WITH_CARD), *_session(_WITHOUT_CARD)]


def _session(lines: str) -> Iterator[Recorded]:
    for number, line in enumerate(filter(None, lines.splitlines())):
        request, phase, response = (column.strip() for column in line.split("|"))
        code, *parameters = request.split()
        sent = phase not in ("in", "-")
        yield Recorded(
            code=code,
            tid=number,
            params=[int(parameter, 16) for parameter in parameters],
            data=phase if sent else None,
            dir="out" if sent else "in" if phase == "in" else None,
            rc=response,
            rparams=[],
        )


def simulated() -> list[Recorded]:
    """Return the same conversation with the simulated EOS 550D in aperture priority and continuous drive."""
    eos = SimulatedEos(EOS_550D, SeededFilm(), SimulatedClock(), auto_power_off_s=0)
    eos.turn_dial(AeMode.APERTURE_PRIORITY)
    eos.set_menu(Property.EOS_DRIVE_MODE, DriveMode.CONTINUOUS)
    # At aperture priority the body has no shutter time until it meters.
    eos.set_menu(Property.EOS_SHUTTER_SPEED, 0)
    return list(_answered(eos))


def _answered(eos: SimulatedEos) -> Iterator[Recorded]:
    for entry in transcript():
        code, sent = int(entry["code"], 16), entry["data"]
        request = PtpRequest(code, entry["tid"], tuple(entry["params"]))
        answer = eos.answer(request, bytes.fromhex(sent) if sent else None)
        assert f"{answer.response.code:04x}" == entry["rc"], entry
        if answer.data is not None:
            entry["data"] = answer.data.hex()
        yield entry
        if code == Operation.CLOSE_SESSION:
            eos.remove_card()


def conversations() -> dict[str, Callable[[], list[Recorded]]]:
    """Return a reader of each available conversation, by the name of its body."""
    found = available("ptp/eos60d_transactions.json")
    return dict([("EOS 550D", simulated), *(("EOS 60D", partial(_read, path)) for path in found)])


def _read(path: Path) -> list[Recorded]:
    return json.loads(path.read_text())


def read_description(data: bytes) -> DevicePropDesc:
    """Return the property of a recorded GetDevicePropDesc; its list has bytes sent as words."""
    cursor = Cursor(data, "a recorded description")
    code, kind, writable = cursor.u16("code"), cursor.u16("type"), cursor.u8("get/set") != 0
    default, current = read_value(cursor, kind, "default"), read_value(cursor, kind, "current")
    listed = cursor.u8("form") == 2
    choices = cursor.integers(cursor.u16("count"), 2, "choices") if listed else ()
    return DevicePropDesc(code, kind, writable, default, current, choices, widened=listed)
