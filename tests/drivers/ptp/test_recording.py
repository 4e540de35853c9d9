"""All that an EOS body and its host sent in two sessions: read to the last byte, and built again.

The body is a real EOS 60D where its recording is found, and in any case the simulated EOS 550D.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from drivers import canon
from drivers.canon import (
    APERTURE,
    ISO,
    AvailableValues,
    DeviceInfoEx,
    ImageFormat,
    Notice,
    PropertyChanged,
    PropertySetting,
    number_of,
)
from drivers.ptp import usb as container
from drivers.ptp.codes import Operation, Property
from drivers.ptp.ip import EndData, OperationRequest, PacketCutter, StartData, encode
from drivers.ptp.protocol import (
    DeviceInfo,
    PtpRequest,
    PtpResponse,
    StorageInfo,
    decode_u32_array,
    encode_u32_array,
)
from drivers.ptp.usb import ContainerReader, DataPiece, DataStart
from tests.drivers.ptp.conversations import Recorded, read_description

REBUILT: dict[int, Callable[[bytes], bytes]] = {
    Operation.GET_DEVICE_INFO: lambda data: DeviceInfo.decode(data).encode(),
    Operation.GET_DEVICE_PROP_DESC: lambda data: read_description(data).encode(),
    Operation.EOS_GET_STORAGE_IDS: lambda data: encode_u32_array(decode_u32_array(data)),
    Operation.EOS_GET_STORAGE_INFO: lambda data: StorageInfo.decode(data).encode(),
    Operation.EOS_GET_DEVICE_INFO_EX: lambda data: DeviceInfoEx.decode(data).encode(),
    Operation.EOS_SET_DEVICE_PROP_VALUE_EX: lambda data: PropertySetting.decode(data).encode(),
    Operation.EOS_GET_EVENT: lambda data: canon.encode_events(canon.decode_events(data)),
}


@dataclass(frozen=True)
class Facts:
    """What a body is and how it stands: of the 60D as other programs read the recording, of the 550D as listed."""

    version: str
    model_id: int
    properties: int
    values: int
    lists: int
    iso: float
    aperture: float
    image_format: str
    battery_percent: int


FACTS = {
    "EOS 60D": Facts("3-1.1.0", 0x80000287, 87, 77, 84, 1600, 4, "JPEG L fine", 50),
    "EOS 550D": Facts("3-1.0.9", 0x80000270, 63, 56, 61, 100, 8, "RAW", 100),
}


def payload(transaction: Recorded) -> bytes:
    return bytes.fromhex(transaction["data"] or "")


def first(recording: list[Recorded], operation: Operation) -> bytes:
    return next(payload(entry) for entry in recording if int(entry["code"], 16) == operation)


def test_every_dataset_is_rebuilt_to_the_byte(recording: list[Recorded]) -> None:
    rebuilt = 0
    for number, entry in enumerate(recording):
        if entry["data"] is not None:
            data = payload(entry)
            assert REBUILT[int(entry["code"], 16)](data) == data, number
            rebuilt += 1
    assert (len(recording), rebuilt) == (70, 48)


def test_every_transaction_crosses_both_cables(recording: list[Recorded]) -> None:
    for entry in recording:
        code, tid, data = int(entry["code"], 16), entry["tid"], payload(entry)
        request, response = PtpRequest(code, tid, tuple(entry["params"])), PtpResponse(int(entry["rc"], 16), tid)
        phase = b"" if entry["data"] is None else container.encode_data_header(code, tid, len(data)) + data
        stream = container.encode(request) + phase + container.encode(response)
        pieces = (stream[at : at + 64] for at in range(0, len(stream), 64))
        reader = ContainerReader(64)
        messages = [message for piece in pieces for message in reader.feed(piece)]
        assert (messages[0], messages[-1]) == (request, response)
        assert b"".join(m.data for m in messages if isinstance(m, DataPiece)) == data
        if entry["data"] is not None:
            assert messages[1] == DataStart(code, tid, len(data))
        packets = [OperationRequest(entry["dir"] == "out", request), StartData(tid, len(data)), EndData(tid, data)]
        assert PacketCutter().feed(b"".join(map(encode, packets))) == packets


def test_commands_are_the_bytes_that_the_host_sent(recording: list[Recorded]) -> None:
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


def test_the_state_dump(body: str, recording: list[Recorded]) -> None:
    facts = FACTS[body]
    records = canon.decode_events(first(recording, Operation.EOS_GET_EVENT))
    # The values, then one notice, then the lists.
    assert Counter(type(record).__name__ for record in records) == {
        "PropertyChanged": facts.values,
        "AvailableValues": facts.lists,
        "AvailableFormats": 2,
        "Notice": 1,
    }
    assert isinstance(records[facts.values], Notice)
    state = {record.code: record for record in records if isinstance(record, PropertyChanged)}
    assert number_of(state[Property.EOS_MODEL_ID].value) == facts.model_id
    assert ISO.value(number_of(state[Property.EOS_ISO_SPEED].value)) == facts.iso
    assert APERTURE.value(number_of(state[Property.EOS_APERTURE].value)) == facts.aperture
    assert str(ImageFormat.decode(state[Property.EOS_IMAGE_FORMAT].value)) == facts.image_format
    lists = {record.code: record.values for record in records if isinstance(record, AvailableValues)}
    assert lists[Property.EOS_CAPTURE_DESTINATION] == (2, 4, 6)
    # Both wear a lens of f/3.5 and offer third stops.
    labels = [APERTURE.label(code) for code in lists[Property.EOS_APERTURE]]
    assert labels[:6] == ["3.5", "4", "4.5", "5", "5.6", "6.3"]
    assert lists[Property.EOS_SHUTTER_SPEED] == ()
