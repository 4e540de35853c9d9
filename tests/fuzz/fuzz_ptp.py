"""Coverage-guided fuzzing of everything that reads PTP: run by hand, never by pytest.

    python -m tests.fuzz.fuzz_ptp -max_total_time=600 -max_len=600 CORPUS/

needs ``pip install atheris``; the arguments are libFuzzer's. An empty CORPUS folder is filled with the well-formed
examples of the tests first. The first byte of an input chooses the reader, the rest is what it reads.

What must hold: nothing but `ProtocolError` is raised; what has been read can be written, and reading that again gives
the same; a stream gives the same messages in one piece and byte by byte.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import atheris

with atheris.instrument_imports():
    from drivers import canon
    from drivers.canon import (
        DeviceInfoEx,
        ImageFormat,
        PropertySetting,
        decode_object_entries,
        encode_object_entries,
    )
    from drivers.ptp import ip as ptpip
    from drivers.ptp import usb as container
    from drivers.ptp.protocol import DeviceInfo, ObjectInfo, StorageInfo, decode_u32_array, encode_u32_array
    from foundation.errors import ProtocolError
    from tests.drivers.ptp import examples

T = TypeVar("T")


def _both(decode: Callable[[bytes], T], encode: Callable[[T], bytes]) -> Callable[[bytes], None]:
    def check(data: bytes) -> None:
        value = decode(data)
        again = decode(encode(value))
        if again != value:
            raise AssertionError(f"{value} is written as {again}")

    return check


def _stream(feed: Callable[[], Callable[[bytes], list[object]]]) -> Callable[[bytes], None]:
    def collect(pieces: list[bytes]) -> tuple[list[object], bool]:
        read, found = feed(), list[object]()
        try:
            for piece in pieces:
                found += read(piece)
            found += read(b"")
        except ProtocolError:
            return found, True
        return found, False

    def check(data: bytes) -> None:
        whole, whole_failed = collect([data])
        if any(isinstance(item, container.DataStart) and item.length is None for item in whole):
            return  # where such a phase ends is told by the pieces themselves
        single, single_failed = collect([data[at : at + 1] for at in range(len(data))])
        if (_joined(whole), whole_failed) != (_joined(single), single_failed):
            raise AssertionError(f"one piece gives {whole}, single bytes give {single}")

    return check


def _joined(items: list[object]) -> list[object]:
    """Return the items with the bytes of neighbouring pieces of data put together."""
    result: list[object] = []
    for item in items:
        match item, result[-1:]:
            case container.DataPiece(more, last), [container.DataPiece(data, False)]:
                result[-1] = container.DataPiece(data + more, last)
            case ptpip.Data(_, b""), _:
                pass
            case ptpip.Data(number, more), [ptpip.Data(before, data)] if number == before:
                result[-1] = ptpip.Data(number, data + more)
            case ptpip.EndData(number, more), [ptpip.Data(before, data)] if number == before:
                result[-1] = ptpip.EndData(number, data + more)
            case _:
                result.append(item)
    return result


def _feed_usb() -> Callable[[bytes], list[object]]:
    reader = container.ContainerReader()
    return lambda piece: [*reader.feed(piece)]


def _feed_ip() -> Callable[[bytes], list[object]]:
    cutter = ptpip.PacketCutter()
    return lambda piece: [*cutter.feed(piece)]


CHECKS: tuple[tuple[Callable[[bytes], None], tuple[bytes, ...]], ...] = (
    (_both(DeviceInfo.decode, DeviceInfo.encode), (examples.DEVICE_INFO,)),
    (_both(ObjectInfo.decode, ObjectInfo.encode), (examples.OBJECT_INFO,)),
    (_both(StorageInfo.decode, StorageInfo.encode), (examples.STORAGE_INFO,)),
    (_both(decode_u32_array, encode_u32_array), (b"\x01\0\0\0\x01\0\x02\0",)),
    (
        _both(canon.decode_events, canon.encode_events),
        (examples.EOS_400D_SHOT[12:], examples.TRANSFER_REQUEST, examples.STATE),
    ),
    (_both(decode_object_entries, encode_object_entries), (examples.OBJECT_ENTRIES,)),
    (_both(DeviceInfoEx.decode, DeviceInfoEx.encode), (examples.DEVICE_INFO_EX,)),
    (_both(PropertySetting.decode, PropertySetting.encode), (examples.SETTING, examples.IMAGE_SETTING)),
    (_both(ImageFormat.decode, ImageFormat.encode), (examples.RAW_FORMAT,)),
    (_both(container.DeviceStatus.decode, container.DeviceStatus.encode), (b"\x08\0\x01\x20\x81\0\0\0",)),
    (_both(container.decode_cancel, container.encode_cancel), (b"\x01\x40\x05\0\0\0",)),
    (_both(ptpip.decode, ptpip.encode), examples.IP_PACKETS),
    (_stream(_feed_usb), (examples.USB_STREAM, examples.EOS_400D_SHOT)),
    (_stream(_feed_ip), (b"".join(examples.IP_PACKETS),)),
)


def check_one(data: bytes) -> None:
    """Read one input of the fuzzer; an exception is a finding."""
    if not data:
        return
    check, _ = CHECKS[data[0] % len(CHECKS)]
    try:
        check(data[1:])
    except ProtocolError:
        return


def main(arguments: list[str]) -> None:
    """Fuzz until libFuzzer's arguments say stop."""
    for folder in map(Path, arguments[1:]):
        if folder.is_dir() and not any(folder.iterdir()):
            for number, (_, seeds) in enumerate(CHECKS):
                for place, seed in enumerate(seeds):
                    (folder / f"seed-{number:02}-{place:02}").write_bytes(bytes([number]) + seed)
    atheris.Setup(arguments, check_one)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv)
