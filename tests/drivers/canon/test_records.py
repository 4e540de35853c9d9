"""Canon's records and dial positions against what bodies have sent, and round trips of whatever they can hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import canon
from drivers.canon import (
    APERTURE,
    ISO,
    SHUTTER,
    AvailableFormats,
    AvailableValues,
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
)
from drivers.ptp.codes import (
    CameraStatus,
    CaptureDestination,
    EosEvent,
    ObjectFormat,
    Operation,
    Property,
    ResponseCode,
)
from foundation.errors import InputError, ProtocolError
from tests.drivers.ptp import examples

U32 = st.integers(0, 0xFFFFFFFF)
U64 = st.integers(0, 0xFFFFFFFFFFFFFFFF)
NAMES = st.text(st.characters(max_codepoint=0xFF, exclude_characters="\0"), max_size=16)
FORMATS = st.builds(ImageFormat, st.lists(st.builds(ImageFile, U32, U32, U32), min_size=1, max_size=2).map(tuple))
NUMBERED = (EosEvent.OBJECT_REMOVED, EosEvent.CAMERA_STATUS_CHANGED, EosEvent.BULB_EXPOSURE_TIME)


@st.composite
def _entries(draw: st.DrawFn, sizes: st.SearchStrategy[int] = U32) -> ObjectEntry:
    time = draw(st.none() | U32)
    width = draw(st.integers(16, 19) if time is None else st.integers(16, 60))
    numbers = [draw(U32) for _ in range(5)]
    name = draw(NAMES)
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
        *(U32, U32, U32, NAMES, st.just(EosEvent.REQUEST_OBJECT_TRANSFER), U32),
        st.tuples(U32).filter(any),
        st.integers(0, 20),
    ),
    st.builds(
        TransferRequest,
        *(U32, U32, U64, NAMES, st.just(EosEvent.REQUEST_OBJECT_TRANSFER_64_LFN), U32),
        st.tuples(U32, U32).filter(any),
    ),
    st.builds(TransferRequest, U32, U32, U64, NAMES, st.just(EosEvent.REQUEST_OBJECT_TRANSFER_64)),
    st.builds(Notice, st.sampled_from(NUMBERED), U32, st.binary(max_size=20)),
    st.builds(OtherRecord, st.integers(0xC1C0, 0xFFFFFFFF), st.binary(max_size=40)),
)


def test_a_shot_of_the_400d() -> None:
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


def test_an_object_that_waits_in_the_camera() -> None:
    request = TransferRequest(0x91910021, ObjectFormat.CR2, 26006080, "IMG_0042.CR2")
    assert canon.decode_events(examples.TRANSFER_REQUEST) == (request,)
    assert canon.encode_events([request]) == examples.TRANSFER_REQUEST


def test_a_request_of_a_body_with_long_names() -> None:
    # libgphoto2's ptp-pack.c quotes this body of a 0xc1b8 record; the name is empty.
    body = bytes.fromhex("40c03214 08b10000 00000000 d41ca602 00000000 00c03214 06000000 00")
    octets = bytes.fromhex("25000000 b8c10000") + body + bytes.fromhex("08000000 00000000")
    (record,) = canon.decode_events(octets)
    assert isinstance(record, TransferRequest)
    assert (record.handle, record.format, record.size, record.name) == (0x1432C040, ObjectFormat.CR3, 0x02A61CD4, "")
    assert canon.encode_events([record]) == octets


def test_a_state_dump() -> None:
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


def test_an_object_of_a_body_with_sizes_of_64_bits() -> None:
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
def test_some_bodies_leave_the_closing_record_out(end: str) -> None:
    record = bytes.fromhex("10000000 89c10000 03d10000 68000000")
    assert canon.decode_events(record + bytes.fromhex(end)) == (PropertyChanged(0xD103, b"\x68\0\0\0"),)
    assert canon.decode_events(2 * record + bytes.fromhex(end)) == 2 * (PropertyChanged(0xD103, b"\x68\0\0\0"),)


def test_more_records_than_any_body_queues_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert canon.MAX_RECORDS == 65536
    monkeypatch.setattr(canon, "MAX_RECORDS", 500)
    notice = bytes.fromhex("0c000000 8bc10000 01000000")
    assert len(canon.decode_events(500 * notice)) == 500
    with pytest.raises(ProtocolError, match="more than 500 records"):
        canon.decode_events(501 * notice)


@pytest.mark.parametrize(
    ("octets", "says"),
    [
        ("10000000 89c10000 03d10000 68000000 08", "the size of a record at byte 16 needs 4 bytes, but only 1 follow"),
        ("07000000 89c10000", "the size of a record at byte 0 is 7; expected at least 8"),
        ("00000000 00000000 01", "expected at least 8"),
        ("ffffffff 89c10000 03d10000", r"PROPERTY_CHANGED \(0xc189\) at byte 8 needs 4294967287 bytes"),
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
def test_records_that_contradict_themselves_are_named(octets: str, says: str) -> None:
    with pytest.raises(ProtocolError, match=says):
        canon.decode_events(bytes.fromhex(octets))


@pytest.mark.parametrize(
    "body",
    [
        "01d10000 01000000 02000000 01000000 02000000",  # a list of a kind without items that has some
        "01d10000 03000000 01000000 01000000 02000000",  # items of a structure that is not known
        "20d10000 03000000 00000000 02000000",
    ],
)
def test_lists_of_unknown_form_stay_as_they_came(body: str) -> None:
    octets = bytes.fromhex(body)
    records = (OtherRecord(EosEvent.AVAILABLE_LIST_CHANGED, octets),)
    assert canon.decode_events(canon.encode_events(records)) == records


def test_more_than_the_bound_is_refused_unread() -> None:
    with pytest.raises(ProtocolError, match="at most 4194304"):
        canon.decode_events(bytes(canon.MAX_EVENTS + 1))


@pytest.mark.slow
@given(st.lists(RECORDS, max_size=6).map(tuple))
def test_any_records_come_back_with_and_without_the_closing_one(records: tuple[Record, ...]) -> None:
    octets = canon.encode_events(records)
    assert canon.decode_events(octets) == canon.decode_events(octets.removesuffix(canon.encode_events())) == records


def test_objects_on_the_card() -> None:
    folder = ObjectEntry(
        0x30000000, 1, ObjectFormat.ASSOCIATION, 0, "DCIM", 0x20000000, 0x30000000, 0x10, 0x4601C3CC, reserved=1
    )
    picture = ObjectEntry(
        0x92740C72,
        0x00020001,
        ObjectFormat.EXIF_JPEG,
        2217241,
        "IMG_0199.JPG",
        0x92740000,
        0x92740C70,
        0x21,
        0x4D987C10,
    )
    assert examples.decode_object_entries(examples.OBJECT_ENTRIES) == (folder, picture)
    assert canon.encode_object_entries((folder, picture)) == examples.OBJECT_ENTRIES


@given(st.lists(_entries(), max_size=5).map(tuple))
def test_any_objects_come_back(entries: tuple[ObjectEntry, ...]) -> None:
    assert examples.decode_object_entries(canon.encode_object_entries(entries)) == entries


def test_what_no_body_could_say_is_our_own_mistake() -> None:
    jpeg = ImageFile(1, 0, 3)
    for files in ((), (jpeg, jpeg, jpeg)):
        with pytest.raises(ValueError, match="a release makes 1 or 2"):
            ImageFormat(files).encode()
    with pytest.raises(ValueError, match="2 extra numbers"):
        canon.encode_events([TransferRequest(1, 0xB103, 0, "A.CR2", extra=(1, 2))])


def test_settings_are_canons_bytes() -> None:
    setting = PropertySetting(Property.EOS_CAPTURE_DESTINATION, canon.number_value(CaptureDestination.HOST))
    assert setting.encode() == examples.SETTING
    assert PropertySetting.decode(examples.SETTING) == setting
    # RAW only: 20 bytes of value, 28 with the header, as facts from the wire have it.
    setting = PropertySetting(Property.EOS_IMAGE_FORMAT, canon.RAW_ONLY.encode())
    assert setting.encode() == examples.IMAGE_SETTING
    assert ImageFormat.decode(PropertySetting.decode(examples.IMAGE_SETTING).value) == canon.RAW_ONLY


SCALES = pytest.mark.parametrize("scale", [SHUTTER, APERTURE, ISO], ids=lambda scale: scale.name)
# The list of apertures that the recorded 60D offered: third stops, f/3.5 to f/22.
APERTURES_60D = (0x25, 0x28, 0x2B, 0x2D, 0x30, 0x33, 0x35, 0x38, 0x3B, 0x3D, 0x40, 0x43, 0x45, 0x48, 0x4B, 0x4D, 0x50)


@SCALES
def test_every_label_finds_its_code_back(scale: Scale) -> None:
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
    # A nominal value lies within a quarter of a stop of the exact one (0.3 s and f/1.8 as half stops are the
    # coarsest), so that no code can be off by a third.
    for step in scale.steps:
        stops = abs(math.log2(step.value / LAWS[scale.name](step.code))) * (2 if scale is APERTURE else 1)
        assert stops < 0.25, (step, stops)


def test_the_list_of_the_body_decides_between_half_and_third_stops() -> None:
    assert SHUTTER.code("1/10") == SHUTTER.code(0.1, [0x50, 0x53, 0x55]) == 0x53
    assert SHUTTER.code("1/10", [0x50, 0x54, 0x58]) == 0x54
    assert APERTURE.code(3.5, APERTURES_60D) == 0x25


def test_what_is_between_is_not_guessed() -> None:
    with pytest.raises(InputError, match=r"^aperture 7\.5 is not offered; near it: 6\.3, 7\.1, 8, 9$"):
        APERTURE.code(7.5, APERTURES_60D)
    with pytest.raises(InputError, match=r"2\.8.*3\.5, 4, 4\.5, 5"):
        APERTURE.code(2.8, APERTURES_60D)
    with pytest.raises(InputError):
        SHUTTER.code("1/60", [])


@pytest.mark.parametrize("wanted", ["", "fast", "1/0", "-1", 0, -1.0, math.nan, math.inf, "nan", "inf", "1/2/3"])
def test_what_is_no_value(wanted: float | str) -> None:
    with pytest.raises(InputError):
        SHUTTER.code(wanted)


def test_bulb_and_auto_are_no_values() -> None:
    assert SHUTTER.code("bulb", [0x0C, 0x10]) == 0x0C
    assert ISO.code("Auto") == 0
    assert SHUTTER.label(0x0C) == "bulb"
    with pytest.raises(ProtocolError):
        SHUTTER.value(0x0C)
    with pytest.raises(ProtocolError):
        APERTURE.value(0)
    with pytest.raises(InputError):
        SHUTTER.code("bulb", [0x10])


def test_codes_lie_where_the_standard_and_the_makers_have_them() -> None:
    """The upper byte of a code says of what it is, and whose."""
    blocks: dict[type[IntEnum], set[int]] = {
        Operation: {0x10, 0x91},
        ResponseCode: {0x20, 0xA0, 0xA1},
        EosEvent: {0x00, 0xC1},
        Property: {0x50, 0xD1, 0xD3, 0xD4},
    }
    for codes, upper in blocks.items():
        assert {code >> 8 for code in codes} == upper
        assert len(codes) == len(codes.__members__), "none has two names"
