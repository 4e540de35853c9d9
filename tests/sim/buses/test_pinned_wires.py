"""What goes over simulated cables, byte by byte, and what damaged bytes of PTP are read as."""

from __future__ import annotations

import enum
import hashlib
from typing import Any

import pytest

from drivers import canon
from drivers.ptp import codes
from drivers.ptp import usb as container
from drivers.ptp.codes import Operation
from drivers.ptp.protocol import PtpRequest, encode_string, encode_value, next_transaction
from foundation.errors import DeviceError
from sim.buses.usb import (
    BULK_IN,
    INTERRUPT_IN,
    Overflowed,
    PtpUsbDevice,
    Stalled,
    UsbIdentity,
)
from tests.drivers.ptp.examples import READERS, STREAMS
from tests.pinned import Pinned
from tests.sim.camera.test_eos import host_of

CANCEL = bytes.fromhex("0140 05000000")


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:8]


def camera() -> PtpUsbDevice:
    return PtpUsbDevice(host_of().eos, UsbIdentity(0x04A9, 0x31EA, "Canon Inc.", "EOS", "0001"))


def test_packets_of_a_device_are_cut_as_before(pinned: Pinned) -> None:
    found: list[str] = []
    requests = [
        PtpRequest(Operation.OPEN_SESSION, 0, (1,)),
        PtpRequest(Operation.GET_DEVICE_INFO, 1),
        PtpRequest(Operation.EOS_SET_EVENT_MODE, 2, (1,)),
        PtpRequest(Operation.EOS_GET_EVENT, 3),
    ]
    for limit in (8, 511, 512, 513, 1024, 4096):
        device = camera()
        for request in requests:
            device.write(2, container.encode(request))
            for endpoint, room in (
                (BULK_IN, limit),
                (BULK_IN, limit),
                (INTERRUPT_IN, min(limit, 8)),
                (INTERRUPT_IN, 16),
            ):
                try:
                    data = device.read(endpoint, room)
                    told = "nothing" if data is None else f"{len(data)} {digest(data)}"
                except (Stalled, Overflowed) as error:
                    told = type(error).__name__
                found.append(f"{limit} {request.code:x} {endpoint:x} {room}: {told}")
    pinned("packets of a device", "\n".join(found).encode())


@pytest.mark.slow
def test_damaged_bytes_of_ptp_are_read_as_before(pinned: Pinned) -> None:
    def is_refused(read: Any, data: bytes) -> bool:
        try:
            read(data)
        except DeviceError:
            return True
        return False

    found: dict[str, list[bool]] = {}
    for name, read, octets in READERS + STREAMS:
        damaged = [
            bytes([*octets[:at], octets[at] ^ flip, *octets[at + 1 :]])
            for at in range(0, len(octets), 1 + len(octets) // 24)
            for flip in (1, 0x80)
        ]
        damaged += [octets[:at] for at in range(0, len(octets), 1 + len(octets) // 6)]
        found[name] = [is_refused(read, one) for one in damaged]
    pinned("damaged bytes of ptp", found)


def test_codes_and_bytes_of_ptp_are_what_they_were(pinned: Pinned) -> None:
    kinds = [one for _, one in sorted(vars(codes).items()) if isinstance(one, type) and issubclass(one, enum.IntEnum)]
    tables = {kind.__name__: [one.value for one in kind] for kind in kinds}
    values = (
        *((1, -5), (2, 200), (3, -300), (4, 60000), (5, -70000), (6, 4000000000), (7, -1), (8, 1 << 40)),
        *((0x4004, (1, 2)), (0xFFFF, "né")),
        # What the wire cannot hold.
        *((2, 256), (0x4002, (1, 999)), (0xFFFF, 5), (4, "x"), (9, 1), (0x4009, (1,))),
    )
    encoded = b""
    for kind, value in values:
        try:
            encoded += encode_value(kind, value)
        except (DeviceError, ValueError):
            encoded += b"refused"
    numbers = [next_transaction(one) for one in (0, 1, 0xFFFFFFFD, 0xFFFFFFFE, 0xFFFFFFFF)]
    texts = b"".join(encode_string(one) for one in ("", "a", "é€"))
    records = [
        canon.PropertyChanged(0xD101, b"\1\0\0\0"),
        canon.AvailableValues(0xD102, (1, 2, 0x98)),
        canon.Notice(0xC18E, 7),
        canon.AvailableFormats(
            0xD120, (canon.RAW_ONLY, canon.ImageFormat((canon.ImageFile(1, 0, 3), canon.ImageFile(6, 0, 4))))
        ),
        canon.OtherRecord(0xC1FE, b"ab"),
    ]
    containers = b"".join(
        container.encode_data_header(0x1001, 7, size) for size in (0, 500, 0xFFFFFFF3, 0xFFFFFFF4, 1 << 40)
    )
    pinned(
        "codes and bytes of ptp",
        {
            **tables,
            "values": encoded,
            "transactions": numbers,
            "texts": texts,
            "events": canon.encode_events(records),
            "containers": containers,
        },
    )
