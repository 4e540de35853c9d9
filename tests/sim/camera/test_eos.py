"""The simulated EOS compared with a recorded conversation, and with the rules of PTP and Canon bodies."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from threading import Event as ThreadEvent
from typing import BinaryIO

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers import canon
from drivers.camera import ExposureSettings
from drivers.canon import (
    AvailableFormats,
    AvailableValues,
    DeviceInfoEx,
    Notice,
    PropertyChanged,
    PropertySetting,
    Record,
    TransferRequest,
    decode_events,
    number_value,
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
from drivers.ptp.protocol import (
    Answer,
    DeviceInfo,
    PtpRequest,
    StorageInfo,
    decode_u32_array,
)
from foundation.clock import SimulatedClock
from foundation.errors import DeviceRefused, LinkClosed
from sim.camera.bodies import EOS_6D_MARK_II, EOS_550D, EOS_550D_AS_LISTED, TEST_BODY, EosModel
from sim.camera.eos import CARD, DCIM, FOLDER, SimulatedEos
from tests.drivers.ptp.conversations import EOS_60D_PROPERTIES, Recorded, conversations, read_description, transcript

REAL = {"the transcript": transcript} | {name: make for name, make in conversations().items() if name == "EOS 60D"}
"""Conversations of the real EOS 60D: without the bytes that it sent, and whole where the recording is found."""


class NumberedFilm:
    """Film whose frames have numbers, and that records the settings."""

    suffix = ".dng"

    def __init__(self, size: int = 3000) -> None:
        self.size = size
        self.exposures: list[tuple[ExposureSettings, datetime]] = []
        self.frames: list[bytes] = []

    def accept(self, settings: ExposureSettings) -> None:
        if settings.shutter_s > 30:
            raise DeviceRefused("the film takes 30 s at most")

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        frame = f"frame {len(self.frames)} ".encode().ljust(self.size, b"\xa5")
        self.exposures.append((settings, released_at))
        self.frames.append(frame)
        return into.write(frame)


class Host:
    """An initiator connected to a body."""

    def __init__(self, eos: SimulatedEos, clock: SimulatedClock, film: NumberedFilm) -> None:
        self.eos = eos
        self.clock = clock
        self.film = film
        self.transaction = 0

    def ask(self, code: int, *parameters: int, data: bytes | None = None) -> Answer:
        request = PtpRequest(code, 0 if code == Operation.OPEN_SESSION else self.next(), parameters)
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

    def set(self, code: int, number: int) -> int:
        setting = PropertySetting(code, number_value(number))
        return self.code(Operation.EOS_SET_DEVICE_PROP_VALUE_EX, data=setting.encode())

    def take_control(self) -> Host:
        self.ok(Operation.OPEN_SESSION, 1)
        self.ok(Operation.EOS_SET_REMOTE_MODE, 1)
        self.ok(Operation.EOS_SET_EVENT_MODE, 1)
        assert self.set(Property.EOS_CAPTURE_DESTINATION, CaptureDestination.HOST) == ResponseCode.OK
        self.ok(Operation.EOS_PC_HDD_CAPACITY, 0x0FFFFFFF, 0x1000, 1)
        self.events()
        return self

    def press(self) -> int:
        code = self.code(Operation.EOS_REMOTE_RELEASE_ON, ReleaseButton.HALF_AND_FULL, 1)
        self.ok(Operation.EOS_REMOTE_RELEASE_OFF, ReleaseButton.HALF_AND_FULL)
        return code

    def shoot(self) -> tuple[Record, ...]:
        """Take a frame and wait for its announcement."""
        assert self.press() == ResponseCode.OK
        self.clock.sleep(60)
        return self.events()


def transfers(records: tuple[Record, ...]) -> list[TransferRequest]:
    return [record for record in records if isinstance(record, TransferRequest)]


def changes(records: tuple[Record, ...]) -> dict[int, bytes]:
    return {record.code: record.value for record in records if isinstance(record, PropertyChanged)}


def lists(records: tuple[Record, ...]) -> dict[int, tuple[int, ...]]:
    return {record.code: record.values for record in records if isinstance(record, AvailableValues)}


def statuses(records: tuple[Record, ...]) -> list[int]:
    return [r.number for r in records if isinstance(r, Notice) and r.type == EosEvent.CAMERA_STATUS_CHANGED]


def host_of(body: EosModel = TEST_BODY) -> Host:
    clock, film = SimulatedClock(), NumberedFilm()
    return Host(SimulatedEos(body, film, clock, card_bytes=8 << 30, auto_power_off_s=0), clock, film)


@pytest.fixture
def host() -> Host:
    return host_of().take_control()


# The real one.


def structure_of(code: int, parameters: list[int], data: bytes) -> object:
    """Return the structure of a data phase, without values that differ between bodies."""
    match code:
        case Operation.GET_DEVICE_INFO:
            info = DeviceInfo.decode(data)
            return info.vendor_extension_id, info.manufacturer, info.properties, len(info.serial_number), info.events
        case Operation.EOS_GET_EVENT:
            records = decode_events(data)
            return {type(record) for record in records}, changes(records).keys() & {Property.EOS_AVAILABLE_SHOTS}
        case Operation.EOS_GET_DEVICE_INFO_EX:
            info_ex = DeviceInfoEx.decode(data)
            return info_ex.events, info_ex.unknown
        case Operation.EOS_GET_STORAGE_IDS:
            return decode_u32_array(data)
        case Operation.EOS_GET_STORAGE_INFO:
            info = StorageInfo.decode(data)
            return info.storage_type, info.filesystem_type, info.capacity > 0, info.free_images, info.description
        case Operation.GET_DEVICE_PROP_DESC:
            described = read_description(data)
            return parameters, described.data_type, described.writable, described.choices, described.widened
        case _:
            raise AssertionError(f"the recording holds data of 0x{code:04x}")


@pytest.mark.parametrize("real", REAL.values(), ids=REAL)
def test_follows_the_recorded_60d(real: Callable[[], list[Recorded]]) -> None:
    host = host_of(EOS_550D)
    host.eos.turn_dial(AeMode.APERTURE_PRIORITY)
    sessions = 0
    for number, recorded in enumerate(real()):
        code = int(recorded["code"], 16)
        request = PtpRequest(code, recorded["tid"], tuple(recorded["params"]))
        if code == Operation.OPEN_SESSION:
            sessions += 1
            if sessions == 2:
                # Its card was taken out between the two sessions.
                host.eos.remove_card()
        data = bytes.fromhex(recorded["data"]) if recorded["data"] else None
        sent = data if recorded["dir"] == "out" else None
        assert host.eos.takes_data(request) == (recorded["dir"] == "out")
        answer = host.eos.answer(request, sent)
        position = f"transaction {number}, 0x{code:04x}"
        assert f"{answer.response.code:04x}" == recorded["rc"], position
        assert len(answer.response.parameters) == len(recorded["rparams"]), position
        assert (answer.data is None) == (recorded["dir"] != "in"), position
        if recorded["dir"] == "in" and data is not None:
            assert answer.data is not None
            ours, theirs = (structure_of(code, recorded["params"], octets) for octets in (answer.data, data))
            assert ours == theirs, position
    assert sessions == 2


def test_reports_properties_in_the_order_of_the_60d() -> None:
    theirs = EOS_60D_PROPERTIES
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


def test_550d_has_the_listed_settings() -> None:
    host = host_of(EOS_550D_AS_LISTED)
    host.ok(Operation.OPEN_SESSION, 1)
    host.ok(Operation.EOS_SET_EVENT_MODE, 1)
    offered = lists(host.events())
    assert [canon.SHUTTER.label(code) for code in offered[Property.EOS_SHUTTER_SPEED]] == LISTED_SHUTTER_550D.split()
    assert [canon.APERTURE.label(code) for code in offered[Property.EOS_APERTURE]] == LISTED_APERTURE_550D.split()
    assert [canon.ISO.label(code) for code in offered[Property.EOS_ISO_SPEED]] == (
        ["auto", "200", "400", "800", "1600", "3200", "6400"]
    )


def test_6d_mark_ii_has_the_listed_settings() -> None:
    host = host_of(EOS_6D_MARK_II)
    info = DeviceInfo.decode(host.ok(Operation.GET_DEVICE_INFO))
    assert (info.manufacturer, info.model, info.device_version) == ("Canon.Inc", "Canon EOS 6D Mark II", "3-1.0.2")
    host.ok(Operation.OPEN_SESSION, 1)
    host.ok(Operation.EOS_SET_EVENT_MODE, 1)
    reported = host.events()
    assert [canon.ISO.label(code) for code in lists(reported)[Property.EOS_ISO_SPEED]] == LISTED_ISO_6D2.split()
    formats = next(
        r.formats for r in reported if isinstance(r, AvailableFormats) and r.code == Property.EOS_IMAGE_FORMAT
    )
    assert len(formats) == 31
    assert [str(formats[at]) for at in (0, 6, 7, 28, 29, 30)] == [
        "JPEG L fine", "JPEG S2 fine", "RAW + JPEG L fine", "RAW", "mRAW", "sRAW",
    ]  # fmt: skip


# Sessions.


@pytest.mark.slow
@example(Operation.EOS_PC_HDD_CAPACITY, [0xFFFFFFFF, 0xFFFFFFFF], None)
@example(Operation.EOS_SET_DEVICE_PROP_VALUE_EX, [], PropertySetting(Property.EOS_CAMERA_TIME, b"\xff" * 4).encode())
@given(
    code=st.sampled_from(Operation),
    parameters=st.lists(st.integers(0, 0xFFFFFFFF) | st.sampled_from([0, 1, 2, 3, CARD, FOLDER, DCIM]), max_size=5),
    data=st.none() | st.binary(max_size=40),
)
def test_answers_all_requests(code: int, parameters: list[int], data: bytes | None) -> None:
    host = host_of().take_control()
    assert host.shoot()
    answer = host.ask(code, *parameters, data=data)
    assert answer.response.ok or answer.data is None
    host.clock.sleep(60)
    assert host.eos.answer(PtpRequest(Operation.OPEN_SESSION, 0, (1,)), None)
    host.transaction = 1000
    host.events()


# Properties.


# Taking pictures.


def test_is_busy_until_the_frame_is_written(host: Host) -> None:
    host.set(Property.EOS_SHUTTER_SPEED, 0x40)
    host.events()
    assert host.press() == ResponseCode.OK
    assert statuses(host.events()) == [1]
    for _ in range(5):
        host.clock.sleep(0.1)
        assert host.set(Property.EOS_ISO_SPEED, 0x58) == ResponseCode.DEVICE_BUSY
        assert host.press() == ResponseCode.DEVICE_BUSY
        assert host.events() == ()
    host.clock.sleep(TEST_BODY.write_s + 0.001)
    records = host.events()
    assert len(transfers(records)) == 1
    assert statuses(records) == [0]
    assert host.set(Property.EOS_ISO_SPEED, 0x58) == ResponseCode.OK
    assert len(host.film.frames) == 1


def test_develops_film_in_the_background() -> None:
    gate = ThreadEvent()

    class SlowFilm(NumberedFilm):
        def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
            assert gate.wait(30)
            return super().expose(settings, released_at, into)

    clock, film = SimulatedClock(), SlowFilm()
    with ThreadPoolExecutor(1) as executor:
        eos = SimulatedEos(TEST_BODY, film, clock, auto_power_off_s=0, executor=executor)
        host = Host(eos, clock, film).take_control()
        assert host.press() == ResponseCode.OK
        clock.sleep(60)
        assert transfers(host.events()) == []
        assert eos.busy
        gate.set()
        executor.submit(lambda: None).result(30)
        clock.sleep(0.02)
        assert len(transfers(host.events())) == 1


# Card.


# What spoils a series.


def test_switches_off_unless_kept_on(host: Host) -> None:
    host.eos.set_menu(Property.EOS_AUTO_POWER_OFF, 30)
    host.ok(Operation.EOS_KEEP_DEVICE_ON)
    host.events()
    for _ in range(5):
        host.clock.sleep(19)
        assert host.events() == ()
        host.ok(Operation.EOS_KEEP_DEVICE_ON)
    host.clock.sleep(22)
    assert [r.type for r in host.events() if isinstance(r, Notice)] == [EosEvent.WILL_SOON_SHUT_DOWN]
    host.ok(Operation.EOS_KEEP_DEVICE_ON)
    assert host.events() == (Notice(EosEvent.SHUTDOWN_TIMER_UPDATED, 30),)
    for _ in range(29):
        # Asking for events keeps no body awake.
        host.clock.sleep(1)
        host.events()
    host.clock.sleep(1)
    assert host.eos.asleep
    with pytest.raises(LinkClosed):
        host.events()
    host.eos.wake()
    assert host.code(Operation.EOS_GET_EVENT) == ResponseCode.SESSION_NOT_OPEN
    host.take_control()
    assert len(transfers(host.shoot())) == 1


# The end of a session.


# With our own driver.
