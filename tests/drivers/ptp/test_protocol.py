"""PTP on any cable: datasets against the standard's bytes, and a session on a scripted cable."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers import canon
from drivers.canon import (
    DeviceInfoEx,
    PropertySetting,
)
from drivers.ptp import protocol
from drivers.ptp import usb as container
from drivers.ptp.codes import DataType, ObjectFormat, Operation, Property, ResponseCode
from drivers.ptp.protocol import (
    OPEN_TRIES,
    TRANSIENT_LIMIT_S,
    DeviceInfo,
    DevicePropDesc,
    ObjectInfo,
    OperationDeclined,
    PtpEvent,
    PtpRequest,
    PtpResponse,
    PtpSession,
    StorageInfo,
    Transaction,
    Value,
    decode_u32_array,
    encode_u32_array,
)
from foundation.clock import SimulatedClock
from foundation.errors import DeviceRefused, LinkClosed, LinkTimeout, ProtocolError
from tests.drivers.ptp import examples
from tests.drivers.ptp.conversations import Recorded, read_description
from tests.drivers.ptp.examples import READERS, STREAMS, U16, U32

U64 = st.integers(0, 0xFFFFFFFFFFFFFFFF)
TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=127)
CODES = st.lists(U16, max_size=20).map(tuple)


def test_device_info_matches_the_standards_bytes() -> None:
    info = DeviceInfo(
        vendor_extension_id=11,
        vendor_extension_version=100,
        vendor_extension="ab",
        operations=(Operation.GET_DEVICE_INFO, Operation.OPEN_SESSION),
        events=(0x4002,),
        capture_formats=(ObjectFormat.EXIF_JPEG,),
        image_formats=(ObjectFormat.EXIF_JPEG, ObjectFormat.CR2),
        manufacturer="C",
        model="EOS",
        device_version="1",
        serial_number="2",
    )
    assert info.encode() == examples.DEVICE_INFO
    assert DeviceInfo.decode(examples.DEVICE_INFO) == info


def test_object_info_matches_the_standards_bytes() -> None:
    info = ObjectInfo(
        storage=0x00020001,
        format=ObjectFormat.CR2,
        size=26006080,
        thumb_format=ObjectFormat.JFIF,
        thumb_size=4096,
        thumb_width=160,
        thumb_height=120,
        image_width=5184,
        image_height=3456,
        bit_depth=14,
        parent=0x31910000,
        filename="IMG_0042.CR2",
    )
    assert info.encode() == examples.OBJECT_INFO
    assert ObjectInfo.decode(examples.OBJECT_INFO) == info


def test_storage_info_keeps_appended_bytes() -> None:
    # 2 x 16 GB nominal: 0x076d880000 bytes of capacity.
    info = StorageInfo(4, 3, 0, 0x076D880000, 0x076CBF8000, 0xFFFFFFFF, "SD", "", b"\0\0")
    assert StorageInfo.decode(examples.STORAGE_INFO) == info
    assert info.encode() == examples.STORAGE_INFO


def test_properties_match_the_standards_bytes() -> None:
    text = DevicePropDesc(0x5003, DataType.STRING, True, "1", "2", ("1", "2"))
    assert text.encode() == examples.STRING_DESC
    # The 60D sends bytes as words.
    battery = DevicePropDesc(0x5001, DataType.UINT8, False, 50, 50, (100, 75, 50, 25, 0), widened=True)
    assert battery.encode() == examples.BATTERY_DESC
    assert replace(battery, widened=False).encode() == bytes.fromhex("0150 0200 00 32 32 02 0500 64 4b 32 19 00")
    assert replace(battery, choices=()).encode() == bytes.fromhex("0150 0200 00 32 32 00")


@pytest.mark.parametrize(
    ("data_type", "value", "octets"),
    [
        (DataType.INT8, -1, "ff"),
        (DataType.UINT8, 255, "ff"),
        (DataType.INT16, -2, "feff"),
        (DataType.UINT16, 0x1234, "3412"),
        (DataType.INT32, -(1 << 31), "00000080"),
        (DataType.UINT32, 0x80000287, "87020080"),
        (DataType.INT64, -1, "ff" * 8),
        (DataType.UINT64, 1, "01" + "00" * 7),
        (DataType.INT128, -1, "ff" * 16),
        (DataType.UINT128, 1 << 120, "00" * 15 + "01"),
        (DataType.STRING, "", "00"),
        (DataType.STRING, "aé\N{GRINNING FACE}", "05 6100 e900 3dd800de 0000"),
        (0x4003, (-1, 2), "02000000 ffff 0200"),
        (0x4006, (), "00000000"),
    ],
)
def test_values_match_the_standards_bytes(data_type: int, value: Value, octets: str) -> None:
    assert protocol.encode_value(data_type, value) == bytes.fromhex(octets)
    assert protocol.decode_value(data_type, bytes.fromhex(octets)) == value


def test_refuses_data_above_the_limit() -> None:
    with pytest.raises(ProtocolError, match="1048576"):
        protocol.decode_u32_array(bytes(protocol.MAX_DATASET + 1))


DATASETS = st.one_of(
    st.builds(DeviceInfo, U16, U32, U16, TEXT, U16, CODES, CODES, CODES, CODES, CODES, TEXT, TEXT, TEXT, TEXT),
    st.builds(StorageInfo, U16, U16, U16, U64, U64, U32, TEXT, TEXT, st.binary(max_size=8)),
    st.builds(
        ObjectInfo,
        *(U32, U16, U16, U32, U16, U32, U32, U32, U32, U32, U32, U32, U16, U32, U32, TEXT, TEXT, TEXT, TEXT),
    ),
)


@given(st.sampled_from([kind for kind in DataType if kind != DataType.STRING]), st.data())
def test_values_survive_encoding_and_decoding(kind: DataType, data: st.DataObject) -> None:
    # In the standard, signed types have odd numbers; pairs of types double in size.
    bits, signed = 8 << (kind - 1) // 2, kind % 2 == 1
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    values = data.draw(st.lists(st.integers(least, most), min_size=1, max_size=5).map(tuple))
    for data_type, value in ((kind, values[0]), (0x4000 | kind, values)):
        assert protocol.decode_value(data_type, protocol.encode_value(data_type, value)) == value


@pytest.mark.slow
@settings(max_examples=200)
@given(DATASETS)
def test_datasets_survive_encoding_and_decoding(dataset: DeviceInfo | StorageInfo | ObjectInfo) -> None:
    assert type(dataset).decode(dataset.encode()) == dataset


class Scripted:
    """A cable that replies with scripted response codes and errors, then with OK."""

    label = "the scripted camera"

    def __init__(self, *script: int | Exception) -> None:
        self.script = list(script)
        self.requests: list[PtpRequest] = []
        self.resets = 0

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        self.requests.append(request)
        step = self.script.pop(0) if self.script else ResponseCode.OK
        if isinstance(step, Exception):
            raise step
        return Transaction(PtpResponse(step, request.transaction, (7,)), b"data")

    def events(self) -> tuple[PtpEvent, ...]:
        return (PtpEvent(0xC101),)

    def reset(self) -> None:
        self.resets += 1

    def close(self) -> None: ...


def opened(*script: int | Exception) -> tuple[PtpSession, Scripted, SimulatedClock]:
    cable, clock = Scripted(*script), SimulatedClock()
    session = PtpSession(cable, clock)
    session.open()
    return session, cable, clock


@pytest.mark.parametrize("answer", [ResponseCode.OK, ResponseCode.SESSION_ALREADY_OPEN])
def test_opens_with_number_0_and_counts_from_1(answer: int) -> None:
    session, cable, _ = opened(answer)
    assert session.call(Operation.GET_DEVICE_INFO) == ((7,), b"data")
    session.close()
    assert cable.requests == [PtpRequest(0x1002, 0, (1,)), PtpRequest(0x1001, 1), PtpRequest(0x1003, 2)]


def test_tries_the_next_session_number() -> None:
    _, cable, _ = opened(ResponseCode.INVALID_TRANSACTION_ID, ResponseCode.INVALID_TRANSACTION_ID)
    assert [request.parameters for request in cable.requests] == [(1,), (2,), (3,)]


def test_resets_a_silent_body() -> None:
    _, cable, _ = opened(LinkTimeout("silent"), ProtocolError("garbage"))
    assert (len(cable.requests), cable.resets) == (OPEN_TRIES, OPEN_TRIES - 1)


@pytest.mark.parametrize("fault", [LinkTimeout("silent"), ProtocolError("garbage")])
def test_reports_a_body_that_stays_silent(fault: Exception) -> None:
    with pytest.raises(type(fault)):
        opened(*[fault] * OPEN_TRIES)


def test_does_not_retry_a_disconnected_body() -> None:
    cable = Scripted(LinkClosed("gone"))
    with pytest.raises(LinkClosed):
        PtpSession(cable, SimulatedClock()).open()
    assert len(cable.requests) == 1


def test_refused_open_is_an_error() -> None:
    with pytest.raises(DeviceRefused, match=r"answers ACCESS_DENIED \(0x200f\) to OPEN_SESSION \(0x1002\)\(0x1\)"):
        opened(ResponseCode.ACCESS_DENIED)


@pytest.mark.parametrize("code", [0x2019, 0xA102, 0xA106])
def test_retries_temporarily_declined_operations(code: int) -> None:
    session, cable, clock = opened(ResponseCode.OK, code, code, code)
    session.call(Operation.EOS_KEEP_DEVICE_ON)
    assert [request.transaction for request in cable.requests[1:]] == [1, 2, 3, 4]
    assert clock.monotonic() == pytest.approx(0.05 + 0.1 + 0.2)


def test_retries_end_after_the_limit() -> None:
    session, _, clock = opened(ResponseCode.OK, *[0x2019] * 1000)
    with pytest.raises(OperationDeclined) as caught:
        session.call(Operation.EOS_KEEP_DEVICE_ON)
    assert caught.value.code == 0x2019
    assert clock.monotonic() == pytest.approx(TRANSIENT_LIMIT_S)


def test_other_responses_are_reported_by_name() -> None:
    session, cable, _ = opened(ResponseCode.OK, 0x200F)
    with pytest.raises(DeviceRefused, match=r"scripted.*ACCESS_DENIED \(0x200f\)"):
        session.call(Operation.EOS_KEEP_DEVICE_ON)
    assert len(cable.requests) == 2


Read = Callable[[bytes], object]
ALL = READERS + STREAMS
EVERY = pytest.mark.parametrize(
    ("read", "octets"), [(read, octets) for _, read, octets in ALL], ids=[n for n, *_ in ALL]
)


def outcome(read: Read, data: bytes) -> object:
    """Return the value or ProtocolError; other errors are raised."""
    try:
        return read(data)
    except ProtocolError:
        return ProtocolError


# A chain of records may end after each of them.
PLAIN = [row for row in READERS if not row[0].startswith("GetEvent")]


@pytest.mark.slow
@pytest.mark.parametrize(("read", "octets"), [row[1:] for row in PLAIN], ids=[row[0] for row in PLAIN])
def test_truncation_at_any_byte(read: Read, octets: bytes) -> None:
    assert outcome(read, octets) is not ProtocolError
    for length in range(1, len(octets)):
        assert outcome(read, octets[:length]) is ProtocolError, length


@pytest.mark.slow
@pytest.mark.parametrize(("read", "octets"), [row[1:] for row in STREAMS], ids=[row[0] for row in STREAMS])
def test_truncated_stream_waits(read: Read, octets: bytes) -> None:
    for length in range(len(octets)):
        assert outcome(read, octets[:length]) is not ProtocolError


@pytest.mark.slow
@EVERY
def test_flipped_byte_gives_a_value_or_an_error(read: Read, octets: bytes) -> None:
    for place in range(len(octets)):
        for flip in (0x01, 0x80, 0xFF):
            damaged = bytearray(octets)
            damaged[place] ^= flip
            outcome(read, bytes(damaged))


@pytest.mark.slow
@EVERY
def test_inflated_number_gives_a_value_or_an_error(read: Read, octets: bytes) -> None:
    for place in range(len(octets) - 3):
        for number in (0, 0x7FFFFFFF, 0xFFFFFFFF, len(octets) + 1):
            damaged = octets[:place] + number.to_bytes(4, "little") + octets[place + 4 :]
            outcome(read, damaged)


@pytest.mark.slow
@pytest.mark.parametrize("read", [read for _, read, _ in ALL], ids=[name for name, *_ in ALL])
def test_any_bytes_give_a_value_or_an_error(read: Read) -> None:
    @settings(max_examples=60)
    @given(st.binary(max_size=200))
    @example(b"")
    @example(b"\xff" * 64)
    def check(data: bytes) -> None:
        outcome(read, data)

    check()


@pytest.mark.slow
@EVERY
def test_counts_do_not_allocate_memory(read: Read, octets: bytes) -> None:
    damaged = [octets[:place] + b"\xff\xff\xff\x0f" + octets[place + 4 :] for place in range(len(octets) - 3)]
    tracemalloc.start()
    try:
        for data in damaged:
            outcome(read, data)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20


REBUILT: dict[int, Callable[[bytes], bytes]] = {
    Operation.GET_DEVICE_INFO: lambda data: DeviceInfo.decode(data).encode(),
    Operation.GET_DEVICE_PROP_DESC: lambda data: read_description(data).encode(),
    Operation.EOS_GET_STORAGE_IDS: lambda data: encode_u32_array(decode_u32_array(data)),
    Operation.EOS_GET_STORAGE_INFO: lambda data: StorageInfo.decode(data).encode(),
    Operation.EOS_GET_DEVICE_INFO_EX: lambda data: DeviceInfoEx.decode(data).encode(),
    Operation.EOS_SET_DEVICE_PROP_VALUE_EX: lambda data: PropertySetting.decode(data).encode(),
    Operation.EOS_GET_EVENT: lambda data: canon.encode_events(canon.decode_events(data)),
}


def payload(transaction: Recorded) -> bytes:
    return bytes.fromhex(transaction["data"] or "")


def test_recorded_datasets_are_rebuilt_exactly(recording: list[Recorded]) -> None:
    rebuilt = 0
    for number, entry in enumerate(recording):
        if entry["data"] is not None:
            data = payload(entry)
            assert REBUILT[int(entry["code"], 16)](data) == data, number
            rebuilt += 1
    assert (len(recording), rebuilt) == (70, 48)


def test_commands_match_the_recorded_host(recording: list[Recorded]) -> None:
    # The host's first four commands, container by container, written from the recording's numbers by hand.
    written = ["10000000 0100 0210 00000000 01000000", "0c000000 0100 0110 01000000"]
    written += ["10000000 0100 1491 02000000 01000000", "10000000 0100 1491 03000000 01000000"]
    for entry, octets in zip(recording, written, strict=False):
        request = PtpRequest(int(entry["code"], 16), entry["tid"], tuple(entry["params"]))
        assert container.encode(request) == bytes.fromhex(octets)
    settings = [payload(entry) for entry in recording if entry["dir"] == "out"]
    destination, aperture = Property.EOS_CAPTURE_DESTINATION, Property.EOS_APERTURE
    sent = [(destination, 4), (aperture, 0x24), (destination, 2), (destination, 4), (aperture, 0x24), (destination, 1)]
    assert [PropertySetting(code, canon.number_value(value)).encode() for code, value in sent] == settings
