"""The simulated EOS against the conversation of a real one, and against the rules that PTP and Canon's bodies keep."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

import pytest

from drivers.camera import ExposureSettings
from drivers.errors import DeviceRefused
from drivers.ptp import apex
from drivers.ptp.canon import (
    AvailableFormats,
    AvailableValues,
    DeviceInfoEx,
    ImageFormat,
    Notice,
    PropertyChanged,
    PropertySetting,
    Record,
    TransferRequest,
    decode_events,
    number_of,
    number_value,
    text_value,
)
from drivers.ptp.codes import (
    AeMode,
    CaptureDestination,
    EosEvent,
    Operation,
    Property,
    ReleaseButton,
    ResponseCode,
)
from drivers.ptp.datasets import (
    DeviceInfo,
    DevicePropDesc,
    StorageInfo,
    decode_u32_array,
)
from drivers.ptp.messages import Request
from sim.clock import SimulatedClock
from sim.eos import SimulatedEos
from sim.eos_bodies import (
    EOS_6D_MARK_II,
    EOS_550D,
    EOS_550D_AS_LISTED,
    EOS_BODIES,
    TEST_BODY,
    EosBody,
)
from sim.responder import Answer

RECORDING = Path(__file__).parents[2].parent / "shared" / "data" / "ptp" / "eos60d_transactions.json"


class NumberedFilm:
    """Film whose frames tell their number, and that notes how each was exposed."""

    suffix = ".dng"

    def __init__(self, size: int = 3000) -> None:
        self.size = size
        self.exposures: list[tuple[ExposureSettings, datetime]] = []
        self.frames: list[bytes] = []
        self.broken = False

    def accept(self, settings: ExposureSettings) -> None:
        if settings.shutter_s > 30:
            raise DeviceRefused("the film takes 30 s at most")

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        if self.broken:
            raise DeviceRefused("the film is torn")
        frame = f"frame {len(self.frames)} ".encode().ljust(self.size, b"\xa5")
        self.exposures.append((settings, released_at))
        self.frames.append(frame)
        return into.write(frame)


class Host:
    """An initiator that holds a body by its wire."""

    def __init__(self, eos: SimulatedEos, clock: SimulatedClock, film: NumberedFilm) -> None:
        self.eos = eos
        self.clock = clock
        self.film = film
        self.transaction = 0

    def ask(self, code: int, *parameters: int, data: bytes | None = None) -> Answer:
        request = Request(code, 0 if code == Operation.OPEN_SESSION else self.next(), parameters)
        if code == Operation.OPEN_SESSION:
            self.transaction = 0
        answer = self.eos.answer(request, data)
        assert answer.response.transaction == request.transaction
        return answer

    def next(self) -> int:
        self.transaction += 1
        return self.transaction

    def code(self, code: int, *parameters: int, data: bytes | None = None) -> int:
        return self.ask(code, *parameters, data=data).response.code

    def ok(self, code: int, *parameters: int, data: bytes | None = None) -> bytes:
        answer = self.ask(code, *parameters, data=data)
        assert answer.response.ok, str(answer.response)
        return answer.data or b""

    def events(self) -> tuple[Record, ...]:
        return decode_events(self.ok(Operation.EOS_GET_EVENT))

    def set(self, code: int, value: int | ImageFormat | str) -> int:
        octets = (
            value.encode()
            if isinstance(value, ImageFormat)
            else text_value(value)
            if isinstance(value, str)
            else number_value(value)
        )
        return self.code(Operation.EOS_SET_DEVICE_PROP_VALUE_EX, data=PropertySetting(code, octets).encode())

    def take_control(self, destination: int = CaptureDestination.HOST) -> Host:
        self.ok(Operation.OPEN_SESSION, 1)
        self.ok(Operation.EOS_SET_REMOTE_MODE, 1)
        self.ok(Operation.EOS_SET_EVENT_MODE, 1)
        assert self.set(Property.EOS_CAPTURE_DESTINATION, destination) == ResponseCode.OK
        self.ok(Operation.EOS_PC_HDD_CAPACITY, 0x0FFFFFFF, 0x1000, 1)
        self.events()
        return self

    def press(self, autofocus: bool = False) -> int:
        code = self.code(Operation.EOS_REMOTE_RELEASE_ON, ReleaseButton.HALF_AND_FULL, int(not autofocus))
        self.ok(Operation.EOS_REMOTE_RELEASE_OFF, ReleaseButton.HALF_AND_FULL)
        return code

    def shoot(self) -> tuple[Record, ...]:
        """Take a picture and wait until it is announced."""
        assert self.press() == ResponseCode.OK
        self.clock.sleep(60)
        return self.events()

    def number(self, code: int) -> int:
        self.ok(Operation.EOS_REQUEST_DEVICE_PROP_VALUE, code)
        return number_of([e for e in self.events() if isinstance(e, PropertyChanged) and e.code == code][-1].value)


def transfers(records: tuple[Record, ...]) -> list[TransferRequest]:
    return [record for record in records if isinstance(record, TransferRequest)]


def changes(records: tuple[Record, ...]) -> dict[int, bytes]:
    return {record.code: record.value for record in records if isinstance(record, PropertyChanged)}


def lists(records: tuple[Record, ...]) -> dict[int, tuple[int, ...]]:
    return {record.code: record.values for record in records if isinstance(record, AvailableValues)}


def statuses(records: tuple[Record, ...]) -> list[int]:
    return [r.number for r in records if isinstance(r, Notice) and r.type == EosEvent.CAMERA_STATUS_CHANGED]


def host_of(body: EosBody = TEST_BODY, *, card_bytes: int | None = 8 << 30, battery: float = 1.0) -> Host:
    clock, film = SimulatedClock(), NumberedFilm()
    return Host(
        SimulatedEos(body, film, clock, card_bytes=card_bytes, battery=battery, auto_power_off_s=0), clock, film
    )


@pytest.fixture
def host() -> Host:
    return host_of().take_control()


# The real one.


def kind_of(code: int, parameters: list[int], data: bytes) -> object:
    """Return what a data phase is, without the values that differ from body to body."""
    match code:
        case Operation.GET_DEVICE_INFO:
            info = DeviceInfo.decode(data)
            return info.vendor_extension_id, info.manufacturer, info.properties, len(info.serial_number), info.events
        case Operation.EOS_GET_EVENT:
            records = decode_events(data)
            return {type(record) for record in records}, changes(records).keys() & {Property.EOS_AVAILABLE_SHOTS}
        case Operation.EOS_GET_DEVICE_INFO_EX:
            info_ex = DeviceInfoEx.decode(data)
            return info_ex.events, info_ex.others
        case Operation.EOS_GET_STORAGE_IDS:
            return decode_u32_array(data)
        case Operation.EOS_GET_STORAGE_INFO:
            info = StorageInfo.decode(data)
            return info.storage_type, info.filesystem_type, info.capacity > 0, info.free_images, info.description
        case Operation.GET_DEVICE_PROP_DESC:
            described = DevicePropDesc.decode(data)
            return parameters, described.data_type, described.writable, described.form
        case _:
            raise AssertionError(f"the recording holds data of 0x{code:04x}")


def test_holds_the_conversation_of_a_real_60d() -> None:
    if not RECORDING.exists():
        pytest.skip("the recorded EOS 60D is not here")
    host = host_of(EOS_550D)
    host.eos.turn_dial(AeMode.APERTURE_PRIORITY)
    sessions = 0
    for number, recorded in enumerate(json.loads(RECORDING.read_text())):
        code = int(recorded["code"], 16)
        request = Request(code, recorded["tid"], tuple(recorded["params"]))
        if code == Operation.OPEN_SESSION:
            sessions += 1
            if sessions == 2:
                # Its card was taken out between the two sessions.
                host.eos.remove_card()
        data = bytes.fromhex(recorded["data"]) if recorded["data"] else None
        sent = data if recorded["dir"] == "out" else None
        assert host.eos.takes_data(request) == (recorded["dir"] == "out")
        answer = host.eos.answer(request, sent)
        place = f"transaction {number}, 0x{code:04x}"
        assert f"{answer.response.code:04x}" == recorded["rc"], place
        assert len(answer.response.parameters) == len(recorded["rparams"]), place
        assert (answer.data is None) == (recorded["dir"] != "in"), place
        if recorded["dir"] == "in":
            assert data is not None
            assert answer.data is not None
            ours, theirs = (kind_of(code, recorded["params"], octets) for octets in (answer.data, data))
            assert ours == theirs, place
    assert sessions == 2


def test_tells_of_itself_in_the_order_of_the_60d() -> None:
    if not RECORDING.exists():
        pytest.skip("the recorded EOS 60D is not here")
    recorded = next(t for t in json.loads(RECORDING.read_text()) if t["code"] == "9108")
    theirs = DeviceInfoEx.decode(bytes.fromhex(recorded["data"])).properties
    ours = [spec.code for spec in EOS_550D.properties]
    assert [code for code in theirs if code in ours] == [code for code in ours if code in theirs]
    assert set(ours) <= set(theirs)


# The lists that owners have published: libgphoto2, cameras/canon-eos550d.txt and canon-eos6d-mark2.txt.

LISTED_SHUTTER_550D = (
    "bulb 30 20 15 10 8 6 4 3 2 1.5 1 0.7 0.5 0.3 1/4 1/6 1/8 1/10 1/15 1/20 1/30 1/45 1/60 1/90 1/125 1/180 1/250 "
    "1/350 1/500 1/750 1/1000 1/1500 1/2000 1/3000 1/4000"
)
LISTED_APERTURE_550D = "4 4.5 5.6 6.7 8 9.5 11 13 16 19 22 27"
LISTED_ISO_6D2 = (
    "auto 100 125 160 200 250 320 400 500 640 800 1000 1250 1600 2000 2500 3200 4000 5000 6400 8000 10000 12800 16000 "
    "20000 25600 32000 40000"
)


def test_a_550d_can_be_the_one_that_was_listed() -> None:
    host = host_of(EOS_550D_AS_LISTED)
    host.ok(Operation.OPEN_SESSION, 1)
    host.ok(Operation.EOS_SET_EVENT_MODE, 1)
    offered = lists(host.events())
    assert [apex.SHUTTER.label(code) for code in offered[Property.EOS_SHUTTER_SPEED]] == LISTED_SHUTTER_550D.split()
    assert [apex.APERTURE.label(code) for code in offered[Property.EOS_APERTURE]] == LISTED_APERTURE_550D.split()
    assert [apex.ISO.label(code) for code in offered[Property.EOS_ISO_SPEED]] == (
        ["auto", "200", "400", "800", "1600", "3200", "6400"]
    )


def test_a_6d_mark_ii_is_the_one_that_was_listed() -> None:
    host = host_of(EOS_6D_MARK_II)
    info = DeviceInfo.decode(host.ok(Operation.GET_DEVICE_INFO))
    assert (info.manufacturer, info.model, info.device_version) == ("Canon.Inc", "Canon EOS 6D Mark II", "3-1.0.2")
    host.ok(Operation.OPEN_SESSION, 1)
    host.ok(Operation.EOS_SET_EVENT_MODE, 1)
    records = host.events()
    assert [apex.ISO.label(code) for code in lists(records)[Property.EOS_ISO_SPEED]] == LISTED_ISO_6D2.split()
    formats = next(
        r.formats for r in records if isinstance(r, AvailableFormats) and r.code == Property.EOS_IMAGE_FORMAT
    )
    assert len(formats) == 31
    assert [str(formats[at]) for at in (0, 6, 7, 28, 29, 30)] == [
        "JPEG L fine", "JPEG S2 fine", "RAW + JPEG L fine", "RAW", "mRAW", "sRAW",
    ]  # fmt: skip


@pytest.mark.parametrize(("name", "product"), [("EOS 550D", 0x31EA), ("EOS 6D Mark II", 0x32CA)])
def test_bodies_have_their_usb_ids(name: str, product: int) -> None:
    assert EOS_BODIES[name].usb == (0x04A9, product)
