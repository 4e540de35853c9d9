"""Well-formed bytes of every kind with the functions that read them, for tests that damage them.

The bytes were written from the standard, or recorded from the named cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise

from hypothesis import strategies as st

from drivers import canon
from drivers.ptp import ip as ptpip
from drivers.ptp import usb as container
from drivers.ptp.protocol import (
    DeviceInfo,
    ObjectInfo,
    StorageInfo,
    decode_u32_array,
    decode_value,
)

# ISO 15740, 5.5.1: version 1.00, vendor 0xb "ab", two operations, one event, no properties, one capture format,
# two image formats, "C", "EOS", "1", "2".
DEVICE_INFO = bytes.fromhex(
    "6400 0b000000 6400 03610062000000 0000"
    "02000000 0110 0210  01000000 0240  00000000  01000000 0138  02000000 0138 03b1"
    "0243000000 0445004f0053000000 0231000000 0232000000"
)
# ISO 15740, 5.5.3: a CR2 of 5184 x 3456 on the card's first store.
OBJECT_INFO = bytes.fromhex(
    "01000200 03b1 0000 40d28c01 0838 00100000 a0000000 78000000 40140000 800d0000 0e000000 00009131 0000 00000000"
    "00000000 0d49004d0047005f0030003000340032002e00430052003200000000 00 00"
)
# EOS 60D, answer to 0x9102: a card of 31.9 GB named SD, with two bytes after the dataset.
STORAGE_INFO = bytes.fromhex("0400 0300 0000 0000886d07000000 0080bf6c07000000 ffffffff 03530044000000 00 0000")
# EOS 60D, property 0x5001: the battery at 50 %, values of one byte sent as two.
BATTERY_DESC = bytes.fromhex("0150 0200 00 32 32 02 0500 6400 4b00 3200 1900 0000")
# ISO 15740, 13.3.3: property 0x5003 as a string of two choices.
STRING_DESC = bytes.fromhex("0350 ffff 01 0231000000 0232000000 02 0200 0231000000 0232000000")
# EOS 400D, reply to 0x9116 after a release, logged by gphoto2 with its container header of 12 bytes.
EOS_400D_SHOT = bytes.fromhex(
    "50000000020016910b070000 3c000000"
    "81c1000052639431 0100010001380000"
    "0000000020000000 8541270000009431"
    "50639431494d475f 313538392e4a5047"
    "00000000f8d2ed49 0800000000000000"
)
# A transfer request in the recorded layout: handle, format, 0, size, 0, name.
TRANSFER_REQUEST = bytes.fromhex(
    "29000000 86c10000 21009191 03b10000 00000000 40d28c01 00000000 494d475f303034322e435232 00 08000000 00000000"
)
# A small state dump: two properties, a list, a list of image formats, a status, an unknown type.
STATE = bytes.fromhex(
    "10000000 89c10000 03d10000 68000000"
    "17000000 89c10000 afd10000 3132383630323730383600"
    "20000000 8ac10000 01d10000 03000000 03000000 25000000 28000000 2b000000"
    "4c000000 8ac10000 20d10000 03000000 02000000"
    "01000000 10000000 06000000 00000000 04000000"
    "02000000 10000000 06000000 00000000 04000000 10000000 01000000 00000000 03000000"
    "0c000000 8bc10000 01000000  0a000000 fec10000 abcd  08000000 00000000"
)
DEVICE_INFO_EX = bytes.fromhex("20000000 02000000 81c10000 89c10000 01000000 01d10000 01000000 04000000")
SETTING = bytes.fromhex("0c000000 1cd10000 04000000")
RAW_FORMAT = bytes.fromhex("01000000 10000000 06000000 00000000 04000000")
IMAGE_SETTING = b"\x1c\0\0\0\x20\xd1\0\0" + RAW_FORMAT

# USB Still Image 1.0, clause 7: GetDevicePropDesc(0x5001), its data phase, OK, an event.
USB_STREAM = (
    bytes.fromhex("10000000 0100 1410 16000000 01500000")
    + bytes.fromhex("20000000 0200 1410 16000000")
    + BATTERY_DESC
    + bytes.fromhex("0c000000 0300 0120 16000000")
    + bytes.fromhex("10000000 0400 01c1 ffffffff 07000000")
)

# CIPA DC-005, 2.3: every packet once, in the order of a conversation.
IP_PACKETS = (
    bytes.fromhex("24000000 01000000 000102030405060708090a0b0c0d0e0f 6c00610062000000 00000100"),
    bytes.fromhex("28000000 02000000 07000000 f0f1f2f3f4f5f6f7f8f9fafbfcfdfeff 45004f0053000000 00000100"),
    bytes.fromhex("0c000000 03000000 07000000"),
    bytes.fromhex("08000000 04000000"),
    bytes.fromhex("0c000000 05000000 01000000"),
    bytes.fromhex("16000000 06000000 01000000 0210 00000000 01000000"),
    bytes.fromhex("12000000 06000000 02000000 1091 05000000"),
    bytes.fromhex("14000000 09000000 05000000 0c00000000000000"),
    bytes.fromhex("10000000 0a000000 05000000 0c000000"),
    bytes.fromhex("14000000 0c000000 05000000 1cd1000004000000"),
    bytes.fromhex("0e000000 07000000 0120 05000000"),
    bytes.fromhex("12000000 08000000 0240 ffffffff 21009191"),
    bytes.fromhex("0c000000 0b000000 05000000"),
    bytes.fromhex("08000000 0d000000"),
    bytes.fromhex("08000000 0e000000"),
)


def read_usb(data: bytes) -> object:
    """Feed a stream to a new reader until it ends or raises."""
    return container.ContainerReader().feed(data)


def read_ip(data: bytes) -> object:
    """Feed a stream to a new cutter until it ends or raises."""
    return ptpip.PacketCutter().feed(data)


READERS: tuple[tuple[str, Callable[[bytes], object], bytes], ...] = (
    ("DeviceInfo", DeviceInfo.decode, DEVICE_INFO),
    ("ObjectInfo", ObjectInfo.decode, OBJECT_INFO),
    ("StorageInfo", StorageInfo.decode, STORAGE_INFO[:-2]),
    ("array", decode_u32_array, bytes.fromhex("02000000 01000200 00000200")),
    ("text", lambda data: decode_value(0xFFFF, data), bytes.fromhex("0361006200 0000")),
    ("array of bytes", lambda data: decode_value(0x4002, data), bytes.fromhex("03000000 010203")),
    ("GetEvent, shot", canon.decode_events, EOS_400D_SHOT[12:]),
    ("GetEvent, transfer", canon.decode_events, TRANSFER_REQUEST),
    ("GetEvent, state", canon.decode_events, STATE),
    ("DeviceInfoEx", canon.DeviceInfoEx.decode, DEVICE_INFO_EX),
    ("setting", canon.PropertySetting.decode, SETTING),
    ("image format", canon.ImageFormat.decode, RAW_FORMAT),
    ("number", canon.number_of, bytes(4)),
    ("device status", container.DeviceStatus.decode, bytes.fromhex("0800 0120 81000000")),
    ("cancel", container.decode_cancel, bytes.fromhex("0140 05000000")),
)
"""What reads bytes whose end is known: a name, the function, bytes that it reads to their last."""

STREAMS: tuple[tuple[str, Callable[[bytes], object], bytes], ...] = (
    ("USB stream", read_usb, USB_STREAM),
    ("PTP/IP stream", read_ip, b"".join(IP_PACKETS)),
    *((f"packet {number}", read_ip, packet) for number, packet in enumerate(IP_PACKETS, 1)),
)
"""What reads streams: cut short they wait for more instead of raising."""

U16 = st.integers(0, 0xFFFF)
U32 = st.integers(0, 0xFFFFFFFF)
PARAMETERS = st.lists(U32, max_size=5).map(tuple)


def split(data: bytes, cuts: Iterable[int]) -> list[bytes]:
    """Return bytes split at the given positions."""
    places = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[start:end] for start, end in pairwise(places)]
