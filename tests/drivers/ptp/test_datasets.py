"""Datasets against bytes written from the standard, and round trips of whatever they can hold."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.ptp import datasets
from drivers.ptp.codes import DataType, ObjectFormat, Operation
from drivers.ptp.datasets import (
    DeviceInfo,
    DevicePropDesc,
    ObjectInfo,
    StorageInfo,
    Value,
)
from foundation.errors import ProtocolError
from tests.drivers.ptp import examples
from tests.drivers.ptp.examples import U16, U32

U64 = st.integers(0, 0xFFFFFFFFFFFFFFFF)
TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=127)
CODES = st.lists(U16, max_size=20).map(tuple)


def test_device_info_is_the_standards_bytes() -> None:
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


def test_object_info_is_the_standards_bytes() -> None:
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


def test_storage_info_keeps_what_a_body_appends() -> None:
    # 2 x 16 GB nominal: 0x076d880000 bytes of capacity.
    info = StorageInfo(4, 3, 0, 0x076D880000, 0x076CBF8000, 0xFFFFFFFF, "SD", "", b"\0\0")
    assert StorageInfo.decode(examples.STORAGE_INFO) == info
    assert info.encode() == examples.STORAGE_INFO


def test_properties_are_the_standards_bytes() -> None:
    text = DevicePropDesc(0x5003, DataType.STRING, True, "1", "2", ("1", "2"))
    assert text.encode() == examples.STRING_DESC
    # The 60D sends bytes as words and means bytes.
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
def test_values_are_the_standards_bytes(data_type: int, value: Value, octets: str) -> None:
    assert datasets.encode_value(data_type, value) == bytes.fromhex(octets)
    assert datasets.decode_value(data_type, bytes.fromhex(octets)) == value


def test_a_string_without_its_nul_can_still_be_written() -> None:
    text = datasets.decode_value(DataType.STRING, b"\xff" + b"x\0" * 255)
    assert text == "x" * 254
    assert datasets.decode_value(DataType.STRING, datasets.encode_value(DataType.STRING, text)) == text


@pytest.mark.parametrize(
    ("octets", "text"),
    [("01 0000", ""), ("03 4300 4600 4600", "CFF"), ("04 4300 0000 4600 0000", "C"), ("02 00d8 0000", "\ufffd")],
)
def test_strings_as_devices_send_them(octets: str, text: str) -> None:
    assert datasets.decode_value(DataType.STRING, bytes.fromhex(octets)) == text


@pytest.mark.parametrize(
    ("data_type", "value"),
    [
        (DataType.UINT8, 256),
        (DataType.INT8, 128),
        (DataType.UINT16, -1),
        (DataType.STRING, "x" * 255),
        (DataType.STRING, "a\0b"),
        (DataType.STRING, "\ud800"),
        (DataType.STRING, 5),
        (DataType.UINT8, "5"),
        (DataType.UINT8, (5,)),
        (0x4002, 5),
        (0x4002, (256,)),
        (0x000B, 5),
        (0xBFFF, "x"),
    ],
)
def test_what_the_wire_cannot_hold_is_our_own_mistake(data_type: int, value: Value) -> None:
    with pytest.raises(ValueError, match=r"."):
        datasets.encode_value(data_type, value)


def test_a_fault_says_what_where_and_how_much() -> None:
    with pytest.raises(ProtocolError, match=r"operations at byte 21 .*65538"):
        DeviceInfo.decode(examples.DEVICE_INFO[:19] + b"\x01\0" + examples.DEVICE_INFO[21:])
    with pytest.raises(ProtocolError, match=r"capacity at byte 6 .*8 .*1"):
        StorageInfo.decode(examples.STORAGE_INFO[:7])


def test_more_than_the_bound_is_refused_unread() -> None:
    with pytest.raises(ProtocolError, match="1048576"):
        datasets.decode_u32_array(bytes(datasets.MAX_DATASET + 1))


DATASETS = st.one_of(
    st.builds(DeviceInfo, U16, U32, U16, TEXT, U16, CODES, CODES, CODES, CODES, CODES, TEXT, TEXT, TEXT, TEXT),
    st.builds(StorageInfo, U16, U16, U16, U64, U64, U32, TEXT, TEXT, st.binary(max_size=8)),
    st.builds(
        ObjectInfo,
        *(U32, U16, U16, U32, U16, U32, U32, U32, U32, U32, U32, U32, U16, U32, U32, TEXT, TEXT, TEXT, TEXT),
    ),
)


@given(st.sampled_from([kind for kind in DataType if kind != DataType.STRING]), st.data())
def test_any_value_comes_back(kind: DataType, data: st.DataObject) -> None:
    # By the standard signed types are the odd ones, and a type of twice the number has half again as many bytes.
    bits, signed = 8 << (kind - 1) // 2, kind % 2 == 1
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    values = data.draw(st.lists(st.integers(least, most), min_size=1, max_size=5).map(tuple))
    for data_type, value in ((kind, values[0]), (0x4000 | kind, values)):
        assert datasets.decode_value(data_type, datasets.encode_value(data_type, value)) == value


@pytest.mark.slow
@settings(max_examples=400)
@given(DATASETS)
def test_any_dataset_comes_back(dataset: DeviceInfo | StorageInfo | ObjectInfo) -> None:
    assert type(dataset).decode(dataset.encode()) == dataset


@given(st.lists(U32, max_size=50).map(tuple))
def test_any_list_of_handles_comes_back(handles: tuple[int, ...]) -> None:
    assert datasets.decode_u32_array(datasets.encode_u32_array(handles)) == handles
