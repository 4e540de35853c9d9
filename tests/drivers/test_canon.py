"""EOS driver against recorded conversations, and against simulated bodies with faults."""

from __future__ import annotations

import io
import math
import re
import tracemalloc
from collections.abc import Callable, Generator
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import canon
from drivers.camera import CameraIdentity, ReportsSupplies, capture
from drivers.canon import (
    APERTURE,
    ISO,
    MAX_LIST,
    MAX_PROPERTIES,
    MAX_VALUE,
    SHUTTER,
    AvailableFormats,
    AvailableValues,
    CanonEos,
    EosState,
    ImageFile,
    ImageFormat,
    Notice,
    ObjectEntry,
    ObjectEvent,
    OtherRecord,
    PropertyChanged,
    PropertySetting,
    Record,
    Scale,
    TransferRequest,
    decode_events,
    encode_events,
    find_setting_faults,
    number_value,
)
from drivers.links.usb import open_usb
from drivers.ptp.codes import (
    AeMode,
    CameraStatus,
    CaptureDestination,
    EosEvent,
    ObjectFormat,
    Operation,
    Property,
    ResponseCode,
)
from drivers.ptp.ip import IpTransport
from drivers.ptp.protocol import Answer, PtpEvent, PtpRequest, PtpResponse, Reception, Responder, Transaction, Transport
from drivers.ptp.usb import UsbTransport
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, DeviceRefused, InputError, LinkClosed, ProtocolError
from sim.buses.ptp import serve_ptpip
from sim.buses.usb import PtpUsbDevice, SimulatedBus
from sim.camera.bodies import EOS_6D_MARK_II, EOS_550D, EosModel
from sim.camera.eos import SimulatedEos
from tests import cable_faults as faults
from tests.cable_faults import Occasion
from tests.contracts.camera import SETTINGS, Bench, CameraContract
from tests.drivers.eos_lab import Lab
from tests.drivers.ptp import examples
from tests.drivers.ptp.conversations import Recorded

IDENTITY = CameraIdentity("Canon Inc.", "Canon EOS 550D", "0000000001", "3-1.0.9")
IDENTITIES = {
    "EOS 60D": CameraIdentity("Canon Inc.", "Canon EOS 60D", "1280627086", "3-1.1.0"),
    "EOS 550D": IDENTITY,
}


class Replay:
    """A cable with a recorded body; requests that were not recorded are errors."""

    label = "the recorded body"

    def __init__(self, transactions: list[Recorded]) -> None:
        self.remaining = list(transactions)
        self.transactions: list[int] = []
        self.requests: list[tuple[int, tuple[int, ...], bytes | None]] = []
        self.closed = False

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        assert receive is None
        assert timeout > 0
        self.transactions.append(request.transaction)
        self.requests.append((request.code, request.parameters, send))
        sent = None if send is None else send.hex()
        for number, entry in enumerate(self.remaining):
            data = entry["data"] if entry["dir"] == "out" else None
            if int(entry["code"], 16) == request.code and tuple(entry["params"]) == request.parameters and data == sent:
                self.remaining = self.remaining[number + 1 :]
                answer = bytes.fromhex(entry["data"] or "") if entry["dir"] == "in" else b""
                response = PtpResponse(int(entry["rc"], 16), request.transaction, tuple(entry["rparams"]))
                return Transaction(response, answer)
        pytest.fail(f"the recorded host did not ask {request} with {sent} here")

    def events(self) -> tuple[PtpEvent, ...]:
        return ()

    def reset(self) -> None:
        pytest.fail("a healthy cable is not reset")

    def close(self) -> None:
        self.closed = True


def test_sends_the_requests_of_the_recorded_host(body: str, recording: list[Recorded]) -> None:
    cable = Replay(recording[:37])
    camera = CanonEos(lambda: cable, SimulatedClock())
    assert camera.identity() == IDENTITIES[body]
    camera.close()
    camera.close()
    assert cable.closed
    assert cable.transactions == list(range(len(cable.transactions)))
    assert cable.remaining == [], "the last of the recorded transactions is the last of ours"
    assert [code for code, _, _ in cable.requests if code != Operation.EOS_GET_EVENT] == [
        0x1002, 0x1001, 0x9114, 0x9115, 0x9127, 0x9110, 0x911A, 0x9110, 0x9114, 0x9115, 0x1003,
    ]  # fmt: skip


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture(params=[False, True], ids=["keeps frames", "forgets frames"])
def moody_lab(request: pytest.FixtureRequest) -> Lab:
    """Labs with a body that keeps its memory at the end of a session, and with one that does not."""
    return Lab(forgetful=request.param)


class TestOverMemory(CameraContract):
    @pytest.fixture
    def bench(self, lab: Lab) -> Bench:
        return Bench(lab.camera, lab.film, IDENTITY, lab.clock.now)


class TestNewerBodyOverMemory(CameraContract):
    @pytest.fixture
    def bench(self) -> Bench:
        lab = Lab(EOS_6D_MARK_II)
        identity = CameraIdentity("Canon.Inc", "Canon EOS 6D Mark II", "0000000001", "3-1.0.2")
        return Bench(lab.camera, lab.film, identity, lab.clock.now)


class TestOverNetwork(CameraContract):
    @pytest.fixture
    def bench(self, lab: Lab) -> Generator[Bench]:
        with serve_ptpip(lab.eos, 0) as server:
            host, port = server.address
            camera = CanonEos(
                lambda: IpTransport.connect(host, port, guid=bytes(16), name="CroP", clock=lab.clock), lab.clock
            )
            yield Bench(camera, lab.film, IDENTITY, lab.clock.now)
            camera.close()


# Body settings that spoil a series.


SPOILS: list[tuple[Callable[[SimulatedEos], None], str]] = [
    (
        lambda eos: eos.turn_dial(AeMode.APERTURE_PRIORITY),
        "the mode dial is set to aperture priority: turn it to M",
    ),
    (lambda eos: eos.turn_dial(AeMode.BULB), "the mode dial is set to bulb"),
    (lambda eos: eos.switch_focus(automatic=True), "autofocus is on: set the lens to MF"),
    (lambda eos: eos.set_menu(Property.EOS_DRIVE_MODE, 1), "the drive mode is continuous: set single shooting"),
    (lambda eos: eos.set_menu(Property.EOS_DRIVE_MODE, 0x11), "the drive mode is timer 2 s"),
    (lambda eos: eos.switch_mirror_lockup(on=True), "mirror lockup is on: switch it off"),
    (lambda eos: eos.set_menu(Property.EOS_AEB, 8), "exposure bracketing is on: switch it off"),
    (lambda eos: eos.set_menu(Property.EOS_AUTO_POWER_OFF, 30), "auto power off is set to 30 s: set it to off"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("spoil", "reason"), SPOILS)
@pytest.mark.parametrize("body", [EOS_550D, EOS_6D_MARK_II], ids=["550D", "6D Mark II"])
def test_refuses_body_settings_that_spoil_a_series(
    spoil: Callable[[SimulatedEos], None], reason: str, body: EosModel
) -> None:
    lab = Lab(body)
    spoil(lab.eos)
    with pytest.raises(DeviceRefused, match=reason):
        lab.camera.configure(SETTINGS)
    assert lab.film.frames == []


def test_restores_or_refuses_a_dial_turned_during_the_series(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    lab.take()
    lab.eos.set_menu(Property.EOS_SHUTTER_SPEED, 0x38)
    lab.eos.set_menu(Property.EOS_IMAGE_FORMAT, ImageFormat((ImageFile(1, 0, 3),)))
    lab.take()
    assert lab.film.settings == [SETTINGS, SETTINGS]
    lab.eos.turn_dial(AeMode.PROGRAM)
    with pytest.raises(DeviceRefused):
        lab.take()


def test_refuses_raw_plus_jpeg() -> None:
    both = ImageFormat((ImageFile(6, 0, 4), ImageFile(1, 0, 3)))
    properties = tuple(
        replace(spec, value=both.encode(), formats=(both,)) if spec.code == Property.EOS_IMAGE_FORMAT else spec
        for spec in EOS_550D.properties
    )
    with pytest.raises(DeviceRefused, match=r"RAW \+ JPEG L fine"):
        Lab(replace(EOS_550D, properties=properties)).camera.configure(SETTINGS)


class RequestRecorder(faults.TroubledResponder):
    """Records the requests to the body."""

    def __init__(self, good: Responder) -> None:
        super().__init__(good)
        self.requests: list[PtpRequest] = []

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        self.requests.append(request)
        return super().answer(request, data)

    def parameters(self, code: int) -> list[tuple[int, ...]]:
        return [request.parameters for request in self.requests if request.code == code]


def record_requests(lab: Lab) -> RequestRecorder:
    lab.device = recorder = RequestRecorder(lab.device)
    return recorder


class ReleaseResult(faults.TroubledResponder):
    """Answers the older release operation with a result."""

    result = 0

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        if request.code == Operation.EOS_REMOTE_RELEASE:
            return Answer(PtpResponse(ResponseCode.OK, request.transaction, (self.result,)))
        return super().answer(request, data)


@pytest.mark.parametrize(
    ("result", "reason"), [(1, "autofocus"), (3, "mirror is up"), (7, "is full"), (8, "read-only"), (25, "result 0x19")]
)
def test_older_release_reports_its_reason(result: int, reason: str) -> None:
    lab = Lab(without=(Operation.EOS_REMOTE_RELEASE_ON,))
    lab.device = device = ReleaseResult(lab.eos)
    device.result = result
    lab.camera.configure(SETTINGS)
    with pytest.raises(DeviceRefused, match=reason):
        lab.take(attempts=1)


CHANGES: dict[str, Callable[[bytes], bytes]] = {
    "short": lambda data: data[:-3],
    "surplus": lambda data: data + b"more",
    "nothing": lambda data: b"",
    "garbage": lambda data: b"\xff" * 64,
}


# libgphoto2 asks GetPartialObject only of a body that has it, else GetObject (get_file_func in its library.c, 2.5.34).

PIECES = (Operation.EOS_GET_PARTIAL_OBJECT, Operation.GET_PARTIAL_OBJECT)


@pytest.mark.slow
@pytest.mark.parametrize("lists", [False, True], ids=["lists none", "refuses both"])
def test_fetches_whole_frames_without_partial_reads(lists: bool) -> None:
    lab = Lab(film_bytes=2_500_000, without=() if lists else PIECES)
    lab.device = faults.Declining(
        lab.eos, ResponseCode.OPERATION_NOT_SUPPORTED, Occasion(set(PIECES) if lists else set(), times=None)
    )
    recorder = record_requests(lab)
    lab.camera.configure(SETTINGS)
    for _ in range(3):
        lab.take(attempts=1)
    assert lab.openings == 1
    assert [len(recorder.parameters(code)) for code in PIECES] == [lists, lists], "it is not requested again"
    assert lab.waiting() == 0


def test_keeps_the_body_awake_in_a_long_wait() -> None:
    lab = Lab(auto_power_off_s=30)
    lab.eos.set_menu(Property.EOS_AUTO_POWER_OFF, 0)
    lab.camera.configure(replace(SETTINGS, shutter_s=30))
    lab.take()
    for _ in range(60):
        lab.clock.sleep(10)
        lab.camera.idle()
    lab.take()
    assert lab.openings == 1


# Faults.

EVERY_OPERATION = (
    Operation.GET_DEVICE_INFO,
    Operation.OPEN_SESSION,
    Operation.EOS_SET_REMOTE_MODE,
    Operation.EOS_SET_EVENT_MODE,
    Operation.EOS_GET_EVENT,
    Operation.EOS_REQUEST_DEVICE_PROP_VALUE,
    Operation.EOS_SET_DEVICE_PROP_VALUE_EX,
    Operation.EOS_PC_HDD_CAPACITY,
    Operation.EOS_REMOTE_RELEASE_ON,
    Operation.EOS_REMOTE_RELEASE_OFF,
    Operation.EOS_GET_PARTIAL_OBJECT,
    Operation.EOS_TRANSFER_COMPLETE,
)
NAMES = [code.name for code in EVERY_OPERATION]


def take_series(lab: Lab, frames: int = 3) -> None:
    """Take a series of frames; no object may remain in the body's memory."""
    lab.camera.configure(SETTINGS)
    for _ in range(frames):
        lab.take()
    assert lab.waiting() == 0
    lab.camera.close()


@pytest.mark.slow
@pytest.mark.parametrize("code", EVERY_OPERATION, ids=NAMES)
@pytest.mark.parametrize(
    ("answer", "times"),
    [
        (ResponseCode.DEVICE_BUSY, 7),
        (ResponseCode.GENERAL_ERROR, 3),
        (ResponseCode.SESSION_NOT_OPEN, 2),
    ],
)
def test_continues_after_a_declined_operation(moody_lab: Lab, code: Operation, answer: int, times: int) -> None:
    moody_lab.device = faults.Declining(moody_lab.eos, answer, Occasion({code}, times=times))
    take_series(moody_lab)


@pytest.mark.slow
@pytest.mark.parametrize("code", EVERY_OPERATION, ids=NAMES)
@pytest.mark.parametrize(
    ("forgetful", "obeys", "after"), [(False, False, 0), (False, True, 3), (True, True, 0), (True, False, 3)]
)
def test_continues_after_an_unanswered_operation(code: Operation, forgetful: bool, obeys: bool, after: int) -> None:
    lab = Lab(forgetful=forgetful)
    lab.device = faults.Hanging(lab.eos, Occasion({code}, after=after), obeys=obeys)
    take_series(lab)


@pytest.mark.slow
@pytest.mark.parametrize("code", EVERY_OPERATION, ids=NAMES)
@pytest.mark.parametrize("after", [0, 3])
def test_reconnects_to_a_body_at_its_new_address(moody_lab: Lab, code: Operation, after: int) -> None:
    bus = SimulatedBus()
    troubled = faults.Interrupting(moody_lab.eos, lambda: bus.replug(device), Occasion({code}, after=after))
    device = PtpUsbDevice(troubled)
    bus.plug(device)
    moody_lab.camera = CanonEos(lambda: UsbTransport(open_usb(backend=bus), moody_lab.clock), moody_lab.clock)
    take_series(moody_lab)


@pytest.mark.slow
@pytest.mark.parametrize("code", EVERY_OPERATION, ids=NAMES)
@pytest.mark.parametrize("after", [0, 3])
def test_continues_after_a_lost_response(moody_lab: Lab, code: Operation, after: int) -> None:
    occasion = Occasion({code}, after=after)
    moody_lab.cable = lambda transport: faults.LosingResponses(transport, occasion)
    take_series(moody_lab)


@pytest.mark.slow
@pytest.mark.parametrize("after", [*range(0, 14_000, 1231), 4095, 4096, 4097, 8192])
def test_continues_after_unplugging_at_any_byte(after: int) -> None:
    lab = Lab(film_bytes=3000)
    lab.pipes = lambda pipes: faults.CutOff(pipes, after) if lab.openings == 1 else pipes
    take_series(lab)
    assert lab.openings > 1


# Garbage in a frame without a stated length is detected only by a decoder.
WRONG = [
    (operation, change)
    for operation in (Operation.EOS_GET_PARTIAL_OBJECT, Operation.GET_PARTIAL_OBJECT, Operation.GET_OBJECT)
    for change in CHANGES
    if change != "garbage" or operation == Operation.GET_PARTIAL_OBJECT
]


@pytest.mark.slow
@pytest.mark.parametrize(("operation", "change"), WRONG)
def test_continues_after_wrong_frame_data(operation: Operation, change: str) -> None:
    without = {Operation.GET_PARTIAL_OBJECT: PIECES[:1], Operation.GET_OBJECT: PIECES}.get(operation, ())
    lab = Lab(without=without)
    lab.device = faults.Falsifying(lab.eos, CHANGES[change], Occasion({operation}))
    take_series(lab)


class Announcing(faults.TroubledResponder):
    """Changes the records in replies to GetEvent."""

    def __init__(self, good: Responder, change: Callable[[tuple[Record, ...]], tuple[Record, ...]]) -> None:
        super().__init__(good)
        self._change = change

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        answer = super().answer(request, data)
        if request.code != Operation.EOS_GET_EVENT or answer.data is None:
            return answer
        return Answer(answer.response, encode_events(self._change(decode_events(answer.data))))


def is_frame(record: Record) -> bool:
    return isinstance(record, TransferRequest)


@pytest.mark.slow
def test_lost_announcement_costs_at_most_one_attempt(moody_lab: Lab, request: pytest.FixtureRequest) -> None:
    seen: list[Record] = []

    def lose_second(records: tuple[Record, ...]) -> tuple[Record, ...]:
        fresh = [record for record in records if is_frame(record) and record not in seen]
        seen.extend(fresh)
        return tuple(record for record in records if not (record in fresh and len(seen) == 2))

    moody_lab.device = Announcing(moody_lab.eos, lose_second)
    take_series(moody_lab)
    assert len(moody_lab.film.frames) == (4 if "forgets" in request.node.name else 3)
    assert moody_lab.openings == 2


@pytest.mark.slow
def test_accepts_late_and_repeated_announcements(lab: Lab) -> None:
    former: list[Record] = []

    def repeat(records: tuple[Record, ...]) -> tuple[Record, ...]:
        again = tuple(former)
        former[:] = [record for record in records if is_frame(record)] or former
        return again + records + tuple(record for record in records if is_frame(record))

    lab.device = Announcing(lab.eos, repeat)
    take_series(lab, 6)
    assert len(lab.film.frames) == 6
    assert lab.openings == 1


@pytest.mark.slow
def test_refuses_an_object_that_is_announced_but_missing(lab: Lab) -> None:
    bogus = TransferRequest(0x77, 0xB103, 600, "IMG_9999.CR2")
    lab.device = Announcing(lab.eos, lambda records: (*records, bogus))
    take_series(lab)
    assert len(lab.film.frames) == 3


def test_late_announcement_is_not_the_next_frame(lab: Lab) -> None:
    held: list[Record] = []

    def hold_first(records: tuple[Record, ...]) -> tuple[Record, ...]:
        if recorder.parameters(Operation.EOS_REMOTE_RELEASE_ON):
            late, held[:] = tuple(held), []
            return records + late
        held.extend(filter(is_frame, records))
        return tuple(record for record in records if not is_frame(record))

    lab.device = Announcing(lab.eos, hold_first)
    recorder = record_requests(lab)
    lab.camera.configure(replace(SETTINGS, shutter_s=1.0))
    lab.press()
    lab.camera.idle()
    assert held
    lab.take(attempts=1)
    assert len(lab.film.frames) == 2
    assert lab.waiting() == 0


def test_resumes_an_interrupted_transfer() -> None:
    lab = Lab(film_bytes=2_500_000)
    recorder = record_requests(lab)
    lab.device = faults.Hanging(lab.device, Occasion({Operation.EOS_GET_PARTIAL_OBJECT}, after=1))
    lab.camera.configure(SETTINGS)
    lab.take(attempts=1)
    asked = recorder.parameters(Operation.EOS_GET_PARTIAL_OBJECT)
    assert [offset for _, offset, _ in asked] == [0, 1 << 20, 2 << 20]
    assert lab.openings == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "format", "comes"),
    [
        ("IMG_0042.CR3", 0xB108, "IMG_0042.CR3"),
        ("IMG_0042", 0xB108, "IMG_0042.CR3"),
        ("IMG_0042", 0xB103, "IMG_0042.CR2"),
        ("", 0xB108, r"[0-9A-F]{8}\.CR3"),
        ("", 0x3000, r"[0-9A-F]{8}"),
        ("../../IMG 1.CR3", 0xB108, r"_\.\._IMG_1\.CR3"),
    ],
)
def test_frame_name_follows_body_and_format(lab: Lab, name: str, format: int, comes: str) -> None:
    lab.device = Announcing(
        lab.eos,
        lambda records: tuple(
            replace(record, name=name, format=format) if isinstance(record, TransferRequest) else record
            for record in records
        ),
    )
    lab.camera.configure(SETTINGS)
    assert re.fullmatch(comes, lab.take(attempts=1).name)


def test_truncates_the_file_after_the_frame(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    into = io.BytesIO(b"former" * 1000)
    capture(lab.camera, into)
    assert into.getvalue() == lab.film.frames[-1]


@pytest.mark.slow
def test_ignores_unknown_records_and_an_endless_queue(lab: Lab) -> None:
    strange = OtherRecord(0xC1FE, b"whatever")
    shutter = Notice(EosEvent.SHUTDOWN_TIMER_UPDATED, 30)
    lab.device = Announcing(lab.eos, lambda records: (strange, *records, *(shutter,) * 20))
    take_series(lab)
    assert len(lab.film.frames) == 3


HINTS: dict[str, Callable[[Responder], Responder]] = {
    "lost": lambda good: faults.ChangingEvents(good, lambda events: ()),
    "late": lambda good: faults.DelayingEvents(good, 5),
    "flooding": lambda good: faults.ChangingEvents(good, lambda events: events * 400),
    "unknown": lambda good: faults.ChangingEvents(good, lambda events: (PtpEvent(0xC1FE, 7, (1, 2, 3)), *events)),
}


@pytest.mark.slow
@pytest.mark.parametrize("trouble", HINTS)
def test_event_pipe_faults_are_harmless(lab: Lab, trouble: str) -> None:
    lab.device = HINTS[trouble](lab.eos)
    take_series(lab)
    assert lab.openings == 1


def announced(size: Callable[[int], int]) -> Callable[[tuple[Record, ...]], tuple[Record, ...]]:
    return lambda records: tuple(
        replace(record, size=size(record.size)) if isinstance(record, TransferRequest) else record for record in records
    )


SIZES: dict[str, Callable[[int], int]] = {
    "too large": lambda size: size + 1,
    "nothing": lambda size: 0,
    "absurd": lambda size: 0xFFFFFFFF,
}


@pytest.mark.parametrize("size", SIZES)
def test_reports_a_wrong_size(lab: Lab, size: str) -> None:
    lab.device = Announcing(lab.eos, announced(SIZES[size]))
    lab.camera.configure(SETTINGS)
    for _ in range(2):
        with pytest.raises(DeviceError):
            lab.take(attempts=1)
        assert lab.waiting() == 1, "it holds only the last exposure"
    assert lab.openings == 1
    lab.camera.close()
    assert lab.waiting() == 0


def test_frees_a_jpeg_next_to_the_raw(lab: Lab) -> None:
    def add_jpeg(records: tuple[Record, ...]) -> tuple[Record, ...]:
        jpeg = TransferRequest(0x78, 0x3801, 10, "IMG_0001.JPG")
        return tuple(item for record in records for item in ((record, jpeg) if is_frame(record) else (record,)))

    lab.device = Announcing(lab.eos, add_jpeg)
    recorder = record_requests(lab)
    take_series(lab, 2)
    freed = [parameters[0] for parameters in recorder.parameters(Operation.EOS_TRANSFER_COMPLETE)]
    assert freed.count(0x78) == 2


def test_discards_frames_of_a_killed_run(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    lab.take()
    # The host is killed while the release is pressed and a frame is exposed.
    lab.device.answer(PtpRequest(Operation.EOS_REMOTE_RELEASE_ON, 1000, (3, 1)), None)
    assert len(lab.film.frames) == 2
    lab.camera = CanonEos(lab.open, lab.clock)
    take_series(lab)
    assert len(lab.film.frames) == 5


def test_empties_a_full_memory(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    for _ in range(EOS_550D.burst):
        lab.press()
    assert lab.waiting() == EOS_550D.burst
    lab.take()
    assert lab.waiting() == 0


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["busy", "silent", "gone", "never announced"])
def test_calls_end_within_their_time_limits(fault: str) -> None:
    lab = Lab()
    lab.camera.configure(SETTINGS)
    always = Occasion({Operation.EOS_GET_EVENT}, times=None)
    lab.device = {
        "busy": lambda: faults.Declining(lab.eos, ResponseCode.DEVICE_BUSY, always),
        "silent": lambda: faults.Hanging(lab.eos, always),
        "gone": lambda: lab.eos,
        "never announced": lambda: Announcing(lab.eos, lambda records: tuple(r for r in records if not is_frame(r))),
    }[fault]()
    if fault == "gone":
        lab.cable = gone_for_good
    lab.pull()
    start = lab.clock.monotonic()
    cause = {
        "busy": "answers DEVICE_BUSY",
        "silent": "sent nothing for 20 s, no connection for",
        "gone": "no camera on USB, no connection for",
        "never announced": "announced no frame in time, and its memory contains no frame",
    }[fault]
    with pytest.raises(DeviceError, match=rf"^(Canon Digital Camera .* at USB port 1-1 )?{cause}"):
        lab.camera.expose()
    # A reply may take 20 s, a declined operation 10 s, and the connection is then renewed for at most 30 s.
    assert lab.clock.monotonic() - start <= {"busy": 45, "silent": 75, "gone": 30, "never announced": 45}[fault]


def gone_for_good(transport: Transport) -> Transport:
    raise LinkClosed("no camera on USB")


def test_keeps_the_frame_if_the_cable_fails_before_download(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    for number in range(3):
        lab.camera.expose()
        lab.pull()
        assert lab.download() == lab.film.frames[number]
        assert lab.waiting() == 0
    assert len(lab.film.frames) == 3


def test_keeps_the_frame_if_the_cable_is_out_for_a_while(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    lab.camera.expose()
    lab.pull()
    lab.cable = gone_for_good
    for _ in range(3):
        with pytest.raises(DeviceError, match="no camera on USB"):
            lab.camera.download(io.BytesIO())
    lab.cable = lambda transport: transport
    assert [lab.download()] == lab.film.frames


def test_reports_lost_frames_once(lab: Lab) -> None:
    lab = Lab(forgetful=True)
    lab.camera.configure(SETTINGS)
    lab.camera.expose()
    lab.pull()
    with pytest.raises(DeviceError):
        lab.camera.download(io.BytesIO())
    with pytest.raises(DeviceError):
        lab.camera.download(io.BytesIO())
    lab.take(attempts=1)


def test_manual_release_does_not_change_the_frame(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    lab.camera.expose()
    lab.press()
    assert lab.download() == lab.film.frames[0]
    assert len(lab.film.frames) == 2
    assert lab.waiting() == 0


def test_configure_drops_a_pending_frame(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    lab.camera.expose()
    lab.camera.configure(SETTINGS)
    assert lab.waiting() == 0
    with pytest.raises(DeviceError):
        lab.camera.download(io.BytesIO())


OPTIONAL = (
    Operation.EOS_REQUEST_DEVICE_PROP_VALUE,
    Operation.EOS_PC_HDD_CAPACITY,
    Operation.EOS_KEEP_DEVICE_ON,
    Operation.EOS_REMOTE_RELEASE_ON,
    Operation.EOS_REMOTE_RELEASE_OFF,
    Operation.EOS_GET_PARTIAL_OBJECT,
    Operation.EOS_GET_STORAGE_IDS,
    Operation.EOS_GET_STORAGE_INFO,
    Operation.CLOSE_SESSION,
)


@pytest.mark.slow
@pytest.mark.parametrize("answer", [ResponseCode.OPERATION_NOT_SUPPORTED, ResponseCode.EOS_UNKNOWN_COMMAND])
@pytest.mark.parametrize("code", OPTIONAL, ids=[code.name for code in OPTIONAL])
def test_continues_without_a_missing_optional_operation(code: Operation, answer: int) -> None:
    lab = Lab()

    class Rooming(faults.TroubledResponder):
        """Has space for frames, and does not support its announcement."""

        def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
            answered = super().answer(request, data)
            if request.code != Operation.EOS_PC_HDD_CAPACITY:
                return answered
            return Answer(PtpResponse(answer, request.transaction))

    lab.device = (
        Rooming(lab.eos)
        if code == Operation.EOS_PC_HDD_CAPACITY
        else faults.Declining(lab.eos, answer, Occasion({code}, times=None))
    )
    recorder = record_requests(lab)
    lab.camera.configure(SETTINGS)
    for _ in range(3):
        lab.take(attempts=1)
        lab.clock.sleep(20)
        lab.camera.idle()
        lab.camera.supplies()
    assert lab.openings == 1
    assert lab.waiting() == 0
    if code not in (Operation.EOS_KEEP_DEVICE_ON, Operation.EOS_REMOTE_RELEASE_OFF):
        assert len(recorder.parameters(code)) <= 1, "it is not requested again"
    lab.camera.close()


# Battery and card capacity.


def test_reads_battery_and_card_capacity(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    supplies = lab.camera.supplies()
    assert isinstance(lab.camera, ReportsSupplies)
    assert (supplies.battery, supplies.mains, supplies.saves_to_host) == (1.0, None, True)
    card = lab.eos._card
    assert card is not None
    assert supplies.card_free_bytes == card.free_bytes
    lab.eos._card = None
    assert lab.camera.supplies().card_free_bytes is None


def test_reads_the_standard_battery_property() -> None:
    properties = tuple(spec for spec in EOS_550D.properties if spec.code != Property.EOS_BATTERY_POWER)
    lab = Lab(replace(EOS_550D, properties=properties), battery=0.75)
    assert lab.camera.supplies().battery == 0.75


def test_absent_camera_is_reported_at_once() -> None:
    clock = SimulatedClock()

    def absent() -> Transport:
        raise LinkClosed("no camera on USB")

    with pytest.raises(LinkClosed, match="on USB"):
        CanonEos(absent, clock).identity()
    assert clock.monotonic() == 0


def test_refuses_another_body(lab: Lab) -> None:
    lab.camera.configure(SETTINGS)
    lab.device = SimulatedEos(EOS_550D, lab.film, lab.clock, serial="0000000002", auto_power_off_s=0)
    lab.pull()
    with pytest.raises(DeviceRefused, match=r"0000000002.* 0000000001"):
        lab.take()


def test_refuses_another_maker(lab: Lab) -> None:
    body = replace(EOS_550D, info=replace(EOS_550D.info, manufacturer="Nikon Corporation", model="D90"))
    with pytest.raises(DeviceRefused, match="Nikon Corporation D90"):
        Lab(body).camera.identity()


# As vcam 47260ba plays an EOS 1300D (src/canon/canon.c): values of all properties, without lists.


def without_lists(records: tuple[Record, ...]) -> tuple[Record, ...]:
    return tuple(record for record in records if not isinstance(record, AvailableValues | AvailableFormats))


def test_accepts_present_values_without_lists(lab: Lab) -> None:
    lab.device = Announcing(lab.eos, without_lists)
    lab.eos.set_menu(Property.EOS_ISO_SPEED, 0x48)
    lab.camera.configure(SETTINGS)
    lab.take(attempts=1)
    assert lab.film.settings == [SETTINGS]
    assert lab.camera.shutter_speeds() == ()
    with pytest.raises(DeviceRefused, match=r"ISO speed 200 is not offered; choose one of the nearest: 100$"):
        lab.camera.configure(replace(SETTINGS, iso=200))


def test_waits_for_a_late_state(lab: Lab) -> None:
    # "The new EOS occasionally returned an empty event set": camera_prepare_canon_eos_capture of libgphoto2 2.5.34.
    held: list[Record] = []

    def late(records: tuple[Record, ...]) -> tuple[Record, ...]:
        if lab.clock.monotonic() < 1:
            held.extend(records)
            return ()
        now, held[:] = (*held, *records), []
        return now

    lab.device = Announcing(lab.eos, late)
    take_series(lab)
    assert lab.openings == 1


def test_sets_electronic_shutter_times() -> None:
    lab = Lab(replace(EOS_550D, shutter_codes=(0x98, 0xA0, 0xA3, 0xA5, 0xA8, 0xAB, 0xAD, 0xB0)))
    assert [round(1 / time) for time in lab.camera.shutter_speeds()] == [
        32000, 25600, 20000, 16000, 12800, 10000, 8000, 4000,
    ]  # fmt: skip
    lab.camera.configure(replace(SETTINGS, shutter_s=1 / 25600))
    lab.take(attempts=1)
    assert lab.film.settings[-1].shutter_s == 1 / 25600


class Slow(faults.TroubledResponder):
    """Is busy for `seconds` after each OpenSession, and as long before each first release on a connection.

    An EOS 2000D is busy after connecting and at its second release (gphoto2, issue 382).
    """

    def __init__(self, lab: Lab, seconds: float) -> None:
        super().__init__(lab.eos)
        self._clock, self._seconds = lab.clock, seconds
        self._ready = self._pressed = float("inf")

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        now = self._clock.monotonic()
        if request.code == Operation.OPEN_SESSION:
            self._ready, self._pressed = now + self._seconds, float("inf")
        elif request.code == Operation.EOS_REMOTE_RELEASE_ON:
            self._pressed = min(self._pressed, now)
            if now < self._pressed + self._seconds:
                return Answer(PtpResponse(ResponseCode.DEVICE_BUSY, request.transaction))
        elif now < self._ready and request.code != Operation.GET_DEVICE_INFO:
            return Answer(PtpResponse(ResponseCode.DEVICE_BUSY, request.transaction))
        return super().answer(request, data)


def test_waits_for_a_busy_body_on_the_same_connection(lab: Lab) -> None:
    lab.device = Slow(lab, 24)
    lab.camera.configure(SETTINGS)
    assert 24 <= lab.clock.monotonic() < 30
    lab.take(attempts=1)
    lab.take(attempts=1)
    assert lab.openings == 1


# Names from libgphoto2's table of cameras (camlibs/ptp2/library.c); those with 0x15 or 0x11 as remote mode
# from `is_canon_eos_m` in its ptp-private.h and camera_prepare_canon_eos_capture in its config.c (2.5.34).


@pytest.mark.parametrize(
    "model", ["EOS M50", "EOS M", "EOS Kiss M", "EOS M50m2", "PowerShot SX540 HS", "PowerShot G5 X"]
)
def test_refuses_bodies_with_another_remote_mode(model: str) -> None:
    lab = Lab(replace(EOS_550D, info=replace(EOS_550D.info, model=f"Canon {model}")))
    recorder = record_requests(lab)
    with pytest.raises(DeviceRefused, match=rf'{model}, .*remote mode.*connection = "gphoto2"'):
        lab.camera.identity()
    assert not recorder.parameters(Operation.EOS_SET_REMOTE_MODE)


# Code 0 and no list, as of a telescope or an adapter: "implicit auto" in libgphoto2's table (canon_aperture in
# camlibs/ptp2/config.c, 2.5.34).


def test_exposes_with_a_lens_without_contacts() -> None:
    lab = Lab(replace(EOS_550D, aperture_codes=()))
    with pytest.raises(DeviceRefused, match=r'aperture 8 cannot be set.*set aperture = "none"'):
        lab.camera.configure(SETTINGS)
    bare = replace(SETTINGS, aperture=None)
    lab.camera.configure(bare)
    lab.take(attempts=1)
    assert lab.film.settings == [bare]


# Records and state.


def test_reads_mirror_lockup_in_recorded_custom_functions(body: str, recording: list[Recorded]) -> None:
    state = EosState()
    records = decode_events(bytes.fromhex(recording[5]["data"] or ""))
    state.update(records)
    assert state.functions[0x060F] == 0
    assert len(state.functions) == {"EOS 60D": 20, "EOS 550D": 2}[body]
    groups = [
        record.value
        for record in records
        if isinstance(record, PropertyChanged) and record.code == Property.EOS_CUSTOM_FUNCTIONS
    ]
    number, count = (0x060F).to_bytes(4, "little"), (1).to_bytes(4, "little")
    (group,) = (value for value in groups if number in value)
    switched_on = group.replace(number + count + bytes(4), number + count + count)
    state.update([PropertyChanged(Property.EOS_CUSTOM_FUNCTIONS, switched_on)])
    assert "mirror lockup is on: switch it off" in find_setting_faults(state)


@pytest.mark.slow
def test_claims_of_a_body_use_little_memory() -> None:
    state = EosState()
    tracemalloc.start()
    for batch in range(8):
        state.update(PropertyChanged(batch << 8 | number, bytes(2 * MAX_VALUE)) for number in range(256))
        state.update(PropertyChanged(batch << 8 | number, bytes(64)) for number in range(256))
        state.update(AvailableValues(batch << 8 | number, tuple(range(16))) for number in range(256))
        state.update([AvailableValues(0xD103, tuple(range(2 * MAX_LIST)))])
        functions = b"".join(number_value(batch << 8 | number) + number_value(0) for number in range(256))
        group = 4 * number_value(1) + number_value(256) + functions
        state.update([PropertyChanged(Property.EOS_CUSTOM_FUNCTIONS, group)])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(state.values) == len(state.lists) == len(state.functions) == MAX_PROPERTIES
    assert peak < 4 << 20


@pytest.mark.parametrize("length", [1 << 32, (1 << 32) - 1, 5 << 20, 1 << 40])
def test_refuses_an_answer_of_gigabytes(length: int) -> None:
    # A container has 32 bits for the length, at most 4 GiB or unknown; PTP/IP has 64.
    reception = Reception(PtpRequest(Operation.EOS_GET_EVENT, 7), None, "the camera")
    with pytest.raises(ProtocolError, match="4194304"):
        reception.start(7, length)


def test_refuses_an_endless_answer() -> None:
    reception = Reception(PtpRequest(Operation.EOS_GET_EVENT, 7), None, "the camera")
    reception.start(7, None)
    for _ in range(64):
        reception.take(bytes(1 << 16))
    with pytest.raises(ProtocolError, match="4194304"):
        reception.take(b"x")


U32 = st.integers(0, 0xFFFFFFFF)
U64 = st.integers(0, 0xFFFFFFFFFFFFFFFF)
RECORD_NAMES = st.text(st.characters(max_codepoint=0xFF, exclude_characters="\0"), max_size=16)
FORMATS = st.builds(ImageFormat, st.lists(st.builds(ImageFile, U32, U32, U32), min_size=1, max_size=2).map(tuple))
NUMBERED = (EosEvent.OBJECT_REMOVED, EosEvent.CAMERA_STATUS_CHANGED, EosEvent.BULB_EXPOSURE_TIME)


@st.composite
def _entries(draw: st.DrawFn, sizes: st.SearchStrategy[int] = U32) -> ObjectEntry:
    time = draw(st.none() | U32)
    width = draw(st.integers(16, 19) if time is None else st.integers(16, 60))
    numbers = [draw(U32) for _ in range(5)]
    name = draw(RECORD_NAMES)
    return ObjectEntry(
        handle=numbers[0],
        storage=numbers[1],
        format=numbers[2],
        size=draw(sizes),
        name=name,
        parent=numbers[3],
        group=numbers[4],
        flags=draw(U32),
        time=time,
        name_width=width,
        reserved=draw(U32),
    )


RECORDS: st.SearchStrategy[Record] = st.one_of(
    st.builds(PropertyChanged, U32, st.binary(max_size=80)),
    st.builds(
        AvailableValues,
        U32.filter(lambda code: code not in canon.IMAGE_FORMAT_PROPERTIES),
        st.lists(U32, max_size=10).map(tuple),
    ),
    st.builds(AvailableValues, U32, st.just(()), st.sampled_from((1, 7))),
    st.builds(
        AvailableFormats,
        st.sampled_from(sorted(canon.IMAGE_FORMAT_PROPERTIES)),
        st.lists(FORMATS, max_size=5).map(tuple),
    ),
    st.builds(ObjectEvent, st.sampled_from((EosEvent.OBJECT_ADDED, EosEvent.OBJECT_INFO_CHANGED)), _entries()),
    st.builds(ObjectEvent, st.just(EosEvent.OBJECT_ADDED_64), _entries(U64)),
    st.builds(
        TransferRequest,
        *(U32, U32, U32, RECORD_NAMES, st.just(EosEvent.REQUEST_OBJECT_TRANSFER), U32),
        st.tuples(U32).filter(any),
        st.integers(0, 20),
    ),
    st.builds(
        TransferRequest,
        *(U32, U32, U64, RECORD_NAMES, st.just(EosEvent.REQUEST_OBJECT_TRANSFER_64_LFN), U32),
        st.tuples(U32, U32).filter(any),
    ),
    st.builds(TransferRequest, U32, U32, U64, RECORD_NAMES, st.just(EosEvent.REQUEST_OBJECT_TRANSFER_64)),
    st.builds(Notice, st.sampled_from(NUMBERED), U32, st.binary(max_size=20)),
    st.builds(OtherRecord, st.integers(0xC1C0, 0xFFFFFFFF), st.binary(max_size=40)),
)


def test_decodes_a_frame_of_the_400d() -> None:
    # 2 572 677 bytes, 21 April 2009 on the camera's clock.
    entry = ObjectEntry(
        handle=0x31946352,
        storage=0x00010001,
        format=ObjectFormat.EXIF_JPEG,
        size=0x274185,
        name="IMG_1589.JPG",
        parent=0x31940000,
        group=0x31946350,
        flags=0x20,
        time=0x49EDD2F8,
    )
    payload = examples.EOS_400D_SHOT[12:]
    assert canon.decode_events(payload) == (ObjectEvent(EosEvent.OBJECT_ADDED, entry),)
    assert canon.encode_events([ObjectEvent(EosEvent.OBJECT_ADDED, entry)]) == payload


def test_decodes_a_transfer_request() -> None:
    request = TransferRequest(0x91910021, ObjectFormat.CR2, 26006080, "IMG_0042.CR2")
    assert canon.decode_events(examples.TRANSFER_REQUEST) == (request,)
    assert canon.encode_events([request]) == examples.TRANSFER_REQUEST


def test_decodes_a_transfer_request_with_long_names() -> None:
    # libgphoto2's ptp-pack.c quotes this body of a 0xc1b8 record; the name is empty.
    body = bytes.fromhex("40c03214 08b10000 00000000 d41ca602 00000000 00c03214 06000000 00")
    octets = bytes.fromhex("25000000 b8c10000") + body + bytes.fromhex("08000000 00000000")
    (record,) = canon.decode_events(octets)
    assert isinstance(record, TransferRequest)
    assert (record.handle, record.format, record.size, record.name) == (0x1432C040, ObjectFormat.CR3, 0x02A61CD4, "")
    assert canon.encode_events([record]) == octets


def test_decodes_a_state_dump() -> None:
    raw, jpeg = ImageFile(6, 0, 4), ImageFile(1, 0, 3)
    records = (
        PropertyChanged(Property.EOS_ISO_SPEED, b"\x68\0\0\0"),
        PropertyChanged(Property.EOS_SERIAL_NUMBER, b"1286027086\0"),
        AvailableValues(Property.EOS_APERTURE, (0x25, 0x28, 0x2B)),
        AvailableFormats(Property.EOS_IMAGE_FORMAT, (canon.RAW_ONLY, ImageFormat((raw, jpeg)))),
        Notice(EosEvent.CAMERA_STATUS_CHANGED, CameraStatus.BUSY),
        OtherRecord(0xC1FE, b"\xab\xcd"),
    )
    assert canon.decode_events(examples.STATE) == records
    assert canon.encode_events(records) == examples.STATE


def test_decodes_an_object_with_64_bit_sizes() -> None:
    # Size at 0x1c of the record, parent at 0x24, the other handle at 0x28, name at 0x2c.
    head = "40000000 a7c10000 21009191 01000200 08b10000 00000000 20000000 0000004001000000 00009191 20009191"
    name = "494d475f303034322e43523300000000 00000000"
    octets = bytes.fromhex(head + name + "08000000 00000000")
    assert octets.index(b"IMG") == 0x2C
    entry = ObjectEntry(
        0x91910021, 0x00020001, ObjectFormat.CR3, 0x1_4000_0000, "IMG_0042.CR3", 0x91910000, 0x91910020, flags=0x20
    )
    assert canon.decode_events(octets) == (ObjectEvent(EosEvent.OBJECT_ADDED_64, entry),)
    assert canon.encode_events([ObjectEvent(EosEvent.OBJECT_ADDED_64, entry)]) == octets


@pytest.mark.parametrize("end", ["", "0000", "00000000 00000000", "00000000 00000000 00000000", "08000000 00000000"])
def test_accepts_a_missing_closing_record(end: str) -> None:
    record = bytes.fromhex("10000000 89c10000 03d10000 68000000")
    assert canon.decode_events(record + bytes.fromhex(end)) == (PropertyChanged(0xD103, b"\x68\0\0\0"),)
    assert canon.decode_events(2 * record + bytes.fromhex(end)) == 2 * (PropertyChanged(0xD103, b"\x68\0\0\0"),)


def test_refuses_too_many_records(monkeypatch: pytest.MonkeyPatch) -> None:
    assert canon.MAX_RECORDS == 65536
    monkeypatch.setattr(canon, "MAX_RECORDS", 500)
    notice = bytes.fromhex("0c000000 8bc10000 01000000")
    assert len(canon.decode_events(500 * notice)) == 500
    with pytest.raises(ProtocolError, match="more than 500 records"):
        canon.decode_events(501 * notice)


@pytest.mark.parametrize(
    ("octets", "reason"),
    [
        ("10000000 89c10000 03d10000 68000000 08", "the size of a record at byte 16 has 1 byte, expected 4"),
        ("07000000 89c10000", "the size of a record at byte 0 is 7, expected at least 8"),
        ("00000000 00000000 01", "expected at least 8"),
        ("ffffffff 89c10000 03d10000", r"PROPERTY_CHANGED \(0xc189\) at byte 8 has 4 bytes, expected 4294967287"),
        ("0a000000 89c10000 03d1 08000000 00000000", "record 0 at byte 0: PROPERTY_CHANGED"),
        (
            "18000000 8ac10000 01d10000 03000000 ffffff7f 00000000 08000000 00000000",
            r"EOS_APERTURE \(0xd101\): values at byte 12 announces 2147483647 items",
        ),
        (
            "28000000 8ac10000 20d10000 03000000 ffffff7f 01000000 10000000 06000000 00000000 04000000"
            "08000000 00000000",
            "the count of files",
        ),
        ("14000000 81c10000 52639431 01000100 01380000 08000000 00000000", "OBJECT_ADDED .*: reserved at byte 12"),
        (
            "24000000 86c10000 21009191 03b10000 00000000 40d28c01 00000000 494d475f494d475f 08000000 00000000",
            "closed by NUL",
        ),
    ],
)
def test_refuses_inconsistent_records(octets: str, reason: str) -> None:
    with pytest.raises(ProtocolError, match=reason):
        canon.decode_events(bytes.fromhex(octets))


@pytest.mark.parametrize(
    "body",
    [
        "01d10000 01000000 02000000 01000000 02000000",  # a list with items, of a kind without items
        "01d10000 03000000 01000000 01000000 02000000",  # items of an unknown structure
        "20d10000 03000000 00000000 02000000",
    ],
)
def test_keeps_lists_of_unknown_form(body: str) -> None:
    octets = bytes.fromhex(body)
    records = (OtherRecord(EosEvent.AVAILABLE_LIST_CHANGED, octets),)
    assert canon.decode_events(canon.encode_events(records)) == records


def test_refuses_data_above_the_limit() -> None:
    with pytest.raises(ProtocolError, match="at most 4194304"):
        canon.decode_events(bytes(canon.MAX_EVENTS + 1))


@pytest.mark.slow
@given(st.lists(RECORDS, max_size=6).map(tuple))
def test_records_survive_encoding_and_decoding(records: tuple[Record, ...]) -> None:
    octets = canon.encode_events(records)
    assert canon.decode_events(octets) == canon.decode_events(octets.removesuffix(canon.encode_events())) == records


def test_settings_match_canons_bytes() -> None:
    setting = PropertySetting(Property.EOS_CAPTURE_DESTINATION, canon.number_value(CaptureDestination.HOST))
    assert setting.encode() == examples.SETTING
    assert PropertySetting.decode(examples.SETTING) == setting
    # RAW only: 20 bytes of value, 28 with the header, as recorded.
    setting = PropertySetting(Property.EOS_IMAGE_FORMAT, canon.RAW_ONLY.encode())
    assert setting.encode() == examples.IMAGE_SETTING
    assert ImageFormat.decode(PropertySetting.decode(examples.IMAGE_SETTING).value) == canon.RAW_ONLY


SCALES = pytest.mark.parametrize("scale", [SHUTTER, APERTURE, ISO], ids=lambda scale: scale.name)
# Apertures offered by the recorded 60D: third stops, f/3.5 to f/22.
APERTURES_60D = (0x25, 0x28, 0x2B, 0x2D, 0x30, 0x33, 0x35, 0x38, 0x3B, 0x3D, 0x40, 0x43, 0x45, 0x48, 0x4B, 0x4D, 0x50)


@SCALES
def test_labels_give_back_their_codes(scale: Scale) -> None:
    for step in scale.steps:
        assert scale.code(step.label, [step.code]) == scale.code(step.value, [step.code]) == step.code


LAWS: dict[str, Callable[[int], float]] = {
    SHUTTER.name: lambda code: 2.0 ** ((0x38 - code) / 8),
    APERTURE.name: lambda code: 2.0 ** ((code - 8) / 16),
    ISO.name: lambda code: 100 * 2.0 ** ((code - 0x48) / 8),
}
"""What a code stands for in stops, unrounded: 2^(-5) s where the camera shows 1/30."""


@SCALES
def test_labels_are_rounded_stops(scale: Scale) -> None:
    # A nominal value is within a quarter of a stop of the exact value (0.3 s and f/1.8 as half stops deviate
    # most), so no code can be wrong by a third.
    for step in scale.steps:
        stops = abs(math.log2(step.value / LAWS[scale.name](step.code))) * (2 if scale is APERTURE else 1)
        assert stops < 0.25, (step, stops)


def test_list_of_the_body_selects_half_or_third_stops() -> None:
    assert SHUTTER.code("1/10") == SHUTTER.code(0.1, [0x50, 0x53, 0x55]) == 0x53
    assert SHUTTER.code("1/10", [0x50, 0x54, 0x58]) == 0x54
    assert APERTURE.code(3.5, APERTURES_60D) == 0x25


def test_refuses_values_between_steps() -> None:
    with pytest.raises(InputError, match=r"^aperture 7\.5 is not offered; .* nearest: 6\.3, 7\.1, 8, 9$"):
        APERTURE.code(7.5, APERTURES_60D)
    with pytest.raises(InputError, match=r"2\.8.*3\.5, 4, 4\.5, 5"):
        APERTURE.code(2.8, APERTURES_60D)
    with pytest.raises(InputError):
        SHUTTER.code("1/60", [])


@pytest.mark.parametrize("setting", ["", "fast", "1/0", "-1", 0, -1.0, math.nan, math.inf, "nan", "inf", "1/2/3"])
def test_refuses_invalid_values(setting: float | str) -> None:
    with pytest.raises(InputError):
        SHUTTER.code(setting)


def test_bulb_and_auto_have_no_value() -> None:
    assert SHUTTER.code("bulb", [0x0C, 0x10]) == 0x0C
    assert ISO.code("Auto") == 0
    assert SHUTTER.label(0x0C) == "bulb"
    with pytest.raises(ProtocolError):
        SHUTTER.value(0x0C)
    with pytest.raises(ProtocolError):
        APERTURE.value(0)
    with pytest.raises(InputError):
        SHUTTER.code("bulb", [0x10])
