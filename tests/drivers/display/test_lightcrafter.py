"""The LightCrafter driver on the simulated bus, and its bytes.

The golden reports follow the layout in TI DLPU010 and DLPU018 as two public clients send it, not the codec under test.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.display import lightcrafter as wire
from drivers.display.lightcrafter import (
    PRODUCTS,
    VENDOR,
    LightCrafter,
    LightCrafterCommand,
    LightCrafterReply,
    LightCrafterRequest,
    find_lightcrafter,
)
from drivers.links.usb import HidDevice, open_hid
from drivers.presenter import BLACK, WHITE, Colour
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, DeviceRefused, InputError, LinkClosed, LinkTimeout, ProtocolError
from sim.buses.usb import SimulatedBus
from sim.projectors.lightcrafter import REPORT_OUT, VIDEO_INPUT, Controller, LightCrafterUsb
from sim.projectors.projector import Screen
from tests.contracts.presenter import Bench, PresenterContract


class Table:
    """A LightCrafter on a bus, and the screen that it lights."""

    def __init__(self, lag: int = 2) -> None:
        self.screen = Screen(WHITE)
        self.controller = Controller(self.screen, lag)
        self.device = LightCrafterUsb(self.controller)
        self.bus = SimulatedBus()
        self.bus.plug(self.device)
        self.clock = SimulatedClock()

    def connect(self) -> HidDevice:
        return open_hid(VENDOR, PRODUCTS["DLPC350"], name="LightCrafter 4500", backend=self.bus)

    def presenter(self) -> LightCrafter:
        return LightCrafter(self.connect, self.clock)


@pytest.fixture
def table() -> Table:
    return Table()


class TestLightCrafter(PresenterContract):
    @pytest.fixture
    def bench(self, table: Table) -> Bench:
        return Bench(table.presenter(), lambda: table.screen.colour)


def golden(text: str) -> bytes:
    return bytes.fromhex(text).ljust(64, b"\0")


GOLDEN = (
    (LightCrafterRequest(1, 0x1A00, b"\x01"), "40 01 03 00 00 1A 01"),
    (LightCrafterRequest(2, 0x1203, b"\x00"), "40 02 03 00 03 12 00"),
    # 1023, 514 = 128 · 1023 / 255 rounded, 0; background black.
    (LightCrafterRequest(3, 0x1204, wire.encode_colour(Colour(255, 128, 0))), "40 03 0E 00 04 12 FF 03 02 02 00 00"),
    (LightCrafterRequest(255, 0x1A1B, b"\x00"), "40 FF 03 00 1B 1A 00"),
    (LightCrafterRequest(4, 0x1204, b"", reads=True), "C0 04 02 00 04 12"),
)


@pytest.mark.parametrize(("request_", "report"), GOLDEN)
def test_requests_are_laid_out_as_published(request_: LightCrafterRequest, report: str) -> None:
    assert wire.encode_request(request_) == golden(report)
    assert wire.parse_request(golden(report)) == request_


def test_replies_are_laid_out_as_published() -> None:
    assert wire.parse_reply(golden("C0 04 01 00 02")) == LightCrafterReply(4, b"\x02")
    assert wire.parse_reply(golden("60 05 00 00")) == LightCrafterReply(5, b"", refused=True)
    assert wire.encode_reply(LightCrafterReply(4, b"\x02"), reads=True) == golden("C0 04 01 00 02")


@given(st.integers(0, 255), st.integers(0, 0xFFFF), st.binary(max_size=wire.MAX_DATA), st.booleans())
def test_requests_survive_the_wire(sequence: int, command: int, data: bytes, reads: bool) -> None:
    request = LightCrafterRequest(sequence, command, data, reads)
    assert wire.parse_request(wire.encode_request(request)) == request


@given(st.binary(max_size=80) | st.binary(min_size=64, max_size=64) | st.binary(min_size=12, max_size=12))
def test_any_bytes_are_a_report_or_a_protocol_error(data: bytes) -> None:
    for parse in (wire.parse_reply, wire.parse_request, wire.parse_colour):
        with contextlib.suppress(ProtocolError):
            parse(data)


@pytest.mark.parametrize(
    ("parse", "data", "told"),
    [
        (wire.parse_reply, b"\xaa" * 64, "claims 43690 bytes of data, at most 60"),
        (wire.parse_reply, b"\xaa" * 63, "has 63 bytes, 64 expected"),
        (wire.parse_colour, b"\xaa" * 60, "in 60 bytes, 12 expected"),
        (wire.parse_colour, b"\xff\x0f" * 6, "gives (4095, 4095, 4095, 4095, 4095, 4095) as its colours, 0 … 1023"),
    ],
)
def test_what_is_wrong_with_a_report_is_said_in_figures(
    parse: Callable[[bytes], object], data: bytes, told: str
) -> None:
    with pytest.raises(ProtocolError) as caught:
        parse(data)
    assert told in str(caught.value)
    assert "aa" not in str(caught.value), "no dump of it"


def test_ten_bits_are_the_nearest_fraction_of_full() -> None:
    for code in range(256):
        assert abs(wire.ten_bits(code) / 1023 - code / 255) <= 0.5 / 1023
        assert wire.eight_bits(wire.ten_bits(code)) == code
    assert (wire.ten_bits(0), wire.ten_bits(255)) == (0, 1023)


def test_nothing_but_black_is_seen_on_the_way_from_video_to_the_generator(table: Table) -> None:
    seen: list[Colour] = []

    class Watched(Controller):
        def write(self, command: int, data: bytes) -> bool:
            done = super().write(command, data)
            seen.append(table.screen.colour)
            return done

        def read(self, command: int) -> bytes | None:
            answer = super().read(command)
            seen.append(table.screen.colour)
            return answer

    table.bus.unplug(table.device)
    table.bus.plug(LightCrafterUsb(Watched(table.screen)))
    table.presenter()
    assert seen[0] == VIDEO_INPUT
    assert seen[-1] == BLACK
    assert set(seen) == {VIDEO_INPUT, BLACK}


def test_waits_until_the_mode_has_changed(table: Table) -> None:
    before = table.clock.monotonic()
    table.presenter()
    assert table.clock.monotonic() > before
    assert table.controller.read(LightCrafterCommand.DISPLAY_MODE) == b"\0"


@pytest.mark.parametrize(("takes_s", "is_waited_for"), [(2.5, True), (4.0, False)])
def test_a_mode_is_waited_for_ten_times_as_long_as_it_takes(table: Table, takes_s: float, is_waited_for: bool) -> None:
    read = table.controller.read

    def later(command: int) -> bytes | None:
        early = table.clock.monotonic() < takes_s
        return b"\1" if early and command == LightCrafterCommand.DISPLAY_MODE else read(command)

    table.controller.read = later  # type: ignore[method-assign, assignment]
    with contextlib.nullcontext() if is_waited_for else pytest.raises(DeviceError, match="display mode"):
        table.presenter()


@pytest.mark.parametrize(
    ("command", "value", "reason"),
    [
        (LightCrafterCommand.PATTERN_COLOUR, wire.encode_colour(Colour(1, 2, 3)), "colour"),
        (LightCrafterCommand.INPUT_SOURCE, b"\0", "0 in place of 1 for input source"),
        (LightCrafterCommand.TEST_PATTERN, b"\4", "4 in place of 0 for test pattern"),
        (LightCrafterCommand.DISPLAY_MODE, b"\1", "1 in place of 0 for display mode"),
    ],
)
def test_what_another_program_changes_is_noticed(command: LightCrafterCommand, value: bytes, reason: str) -> None:
    table = Table(lag=0)
    presenter = table.presenter()
    write = table.controller.write

    changed, to = command, value

    def meddle(command: int, data: bytes) -> bool:
        return write(command, data) and write(changed, to)

    table.controller.write = meddle  # pyrefly: ignore[method-assign]
    with pytest.raises(DeviceError, match=rf"confirms {reason}.*close other control programs"):
        presenter.show(WHITE)


def test_a_command_that_the_firmware_does_not_know(table: Table) -> None:
    del table.controller.registers[LightCrafterCommand.PATTERN_COLOUR]
    with pytest.raises(DeviceRefused, match="refuses command 0x1204"):
        table.presenter()


def test_goes_on_after_the_cable_was_pulled(table: Table) -> None:
    presenter = table.presenter()
    table.bus.unplug(table.device)
    for _ in range(2):
        with pytest.raises(LinkClosed):
            presenter.show(WHITE)
    table.bus.plug(table.device)
    presenter.show(Colour(5, 6, 7))
    assert table.screen.colour == Colour(5, 6, 7)
    table.bus.unplug(table.device)
    presenter.close()


def test_a_late_answer_is_no_answer(table: Table) -> None:
    presenter = table.presenter()
    late = LightCrafterRequest(200, LightCrafterCommand.DISPLAY_MODE, reads=True)
    table.device.write(REPORT_OUT, wire.encode_request(late))
    presenter.show(Colour(5, 6, 7))
    assert table.screen.colour == Colour(5, 6, 7)


@pytest.mark.parametrize("swallow", [True, False])
def test_silence_and_foreign_answers_are_timeouts(table: Table, swallow: bool) -> None:
    presenter = table.presenter()

    def write(endpoint: int, data: bytes) -> None:
        if not swallow:
            for _ in range(20):
                foreign = wire.encode_request(LightCrafterRequest(99, 0x1A00, reads=True))
                LightCrafterUsb.write(table.device, endpoint, foreign)

    table.device.write = write  # pyrefly: ignore[method-assign]
    with pytest.raises(LinkTimeout):
        presenter.show(WHITE)


def opening(change: Callable[[SimulatedBus, LightCrafterUsb], None]) -> HidDevice:
    table = Table()
    change(table.bus, table.device)
    return table.connect()


@pytest.mark.parametrize(
    ("change", "kind", "reason"),
    [
        (SimulatedBus.unplug, LinkClosed, r"no LightCrafter 4500 \(0451:6401\) on USB"),
        (SimulatedBus.hold, DeviceRefused, "held by another program"),
        (SimulatedBus.lock, DeviceRefused, "udev rule"),
        (SimulatedBus.plug, InputError, "2 devices on USB fit"),
    ],
)
def test_what_cannot_be_opened_says_why(
    change: Callable[[SimulatedBus, LightCrafterUsb], None], kind: type[Exception], reason: str
) -> None:
    with pytest.raises(kind, match=reason):
        opening(change)


def test_is_told_from_its_like_by_serial_number(table: Table) -> None:
    table.bus.plug(LightCrafterUsb(Controller(Screen()), serial="other"), port=2)
    device = open_hid(VENDOR, PRODUCTS["DLPC350"], name="LightCrafter", serial="other", backend=table.bus)
    assert device.label == "LightCrafter (0451:6401, serial number other)"
    device.close()
    with pytest.raises(LinkClosed, match="closed"):
        device.read(1.0)


@pytest.mark.parametrize("controller", sorted(PRODUCTS))
def test_either_controller_is_found(controller: str) -> None:
    screen, bus = Screen(), SimulatedBus()
    bus.plug(LightCrafterUsb(Controller(screen), PRODUCTS[controller], serial="7"))
    presenter = LightCrafter(lambda: find_lightcrafter("7", backend=bus), SimulatedClock())
    presenter.show(WHITE)
    assert screen.colour == WHITE
    with pytest.raises(LinkClosed, match=r"serial number 8 .*0451:6401"):
        find_lightcrafter("8", backend=bus)


def test_the_kernel_gets_the_device_back(table: Table) -> None:
    table.bus.bind_kernel_driver(table.device)
    presenter = table.presenter()
    assert not table.bus.kernel_driver_sits_on(table.device)
    presenter.close()
    assert table.bus.kernel_driver_sits_on(table.device)
    assert not table.bus.is_claimed(table.device)
