"""PJLink over UDP as bytes: how class 2 projectors are found, and the notices that they send.

Rules that hold inside:

- Pure functions of a datagram's bytes; both ends of the cable are here.
- What arrives unasked is not to be trusted: a datagram that holds nothing of ours is an empty answer, no error.

A controller broadcasts the search; each projector answers within 10 s with its MAC address. A projector also sends
notices to the one controller whose address was entered in its menu: of its start, and of each change of fault, power
and input. Nothing here is proved by a password.

Source: JBMIA, PJLink Specifications 2.00 and 2.10, 3.2 (search) and 3.3 (status notification).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.pjlink import wire
from drivers.projector import Fault, Power
from foundation.errors import ProtocolError

SEARCH = b"%2SRCH\r"
COLLECT_S = 30.0
"""So long a controller collects answers, which projectors delay by up to 10 s."""


@dataclass(frozen=True)
class Found:
    """The answer to a search: the projector's MAC address, six pairs of lowercase hex digits with colons."""

    mac: str


@dataclass(frozen=True)
class LinkUp:
    """A projector has come up and can be controlled; `mac` as in `Found`."""

    mac: str


@dataclass(frozen=True)
class FaultsChanged:
    """Every fault that is there now; empty when healthy again."""

    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class PowerChanged:
    """The new power state."""

    power: Power


@dataclass(frozen=True)
class InputChanged:
    """The code of the input that is shown now."""

    code: str


PjLinkNotice = LinkUp | FaultsChanged | PowerChanged | InputChanged


def is_search(datagram: bytes) -> bool:
    """Return whether a datagram asks projectors to answer."""
    return datagram.strip(b"\0\r\n ").upper() == b"%2SRCH"


def encode(message: Found | PjLinkNotice) -> bytes:
    """Return the datagram of an answer or a notice."""
    match message:
        case Found(mac):
            text = f"ACKN={mac}"
        case LinkUp(mac):
            text = f"LKUP={mac}"
        case FaultsChanged(faults):
            text = f"ERST={wire.format_faults({fault.part: fault.severity for fault in faults})}"
        case PowerChanged(power):
            text = f"POWR={wire.format_power(power)}"
        case InputChanged(code):
            text = f"INPT={code}"
    return f"%2{text}\r".encode("ascii")


def decode(datagram: bytes) -> tuple[Found | PjLinkNotice, ...]:
    """Return the answers and notices in a datagram, in their order; what is neither is passed over."""
    messages = (_message(line) for line in re.split(rb"[\r\n\0]+", datagram))
    return tuple(message for message in messages if message is not None)


def is_notice_of_start(line: bytes) -> bool:
    """Return whether a line is LKUP, which some projectors send into a controller's TCP connection as well."""
    return isinstance(_message(line), LinkUp)


def _message(line: bytes) -> Found | PjLinkNotice | None:
    try:
        reply = wire.parse_reply(line.strip())
        if not isinstance(reply, wire.PjLinkReply) or reply.level != 2:
            return None
        match reply.command:
            case "ACKN":
                return Found(_mac(reply.value))
            case "LKUP":
                return LinkUp(_mac(reply.value))
            case "ERST":
                return FaultsChanged(wire.parse_faults(reply.value))
            case "POWR":
                return PowerChanged(wire.parse_power(reply.value))
            case "INPT":
                return InputChanged(wire.parse_input(reply.value))
            case _:
                return None
    except ProtocolError:
        return None


def _mac(value: str) -> str:
    if not re.fullmatch("[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}", value):
        raise ProtocolError(f"the projector names itself {value!r}; expected a MAC address")
    return value.lower()
