"""Serial cable: the link contract on a pseudo-terminal, and all errors of opening."""

from __future__ import annotations

import errno
import os
import select
import tty
from collections.abc import Iterator

import pytest
import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from drivers.links.serial import SerialLink
from foundation.errors import ConfigurationError, DeviceRefused, LinkClosed, LinkTimeout
from tests.contracts.link import PATIENCE_S, Ends, LinkContract, read_exactly


class FarEnd:
    """The other end of a pseudo-terminal's cable."""

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._open = True

    def write(self, data: bytes, timeout: float) -> None:
        while data:
            data = data[os.write(self._master, data) :]

    def read(self, limit: int, timeout: float) -> bytes:
        if not select.select([self._master], [], [], timeout)[0]:
            if not timeout:
                return b""
            raise LinkTimeout("nothing came")
        return os.read(self._master, limit)

    def close(self) -> None:
        if self._open:
            self._open = False
            os.close(self._master)
            os.close(self._slave)


@pytest.fixture
def far() -> Iterator[FarEnd]:
    end = FarEnd()
    yield end
    end.close()


class TestSerialLink(LinkContract):
    @pytest.fixture
    def ends(self, far: FarEnd) -> Iterator[Ends]:
        near = SerialLink.open(far.path, 9600)
        yield near, far
        near.close()

    def test_reads_data_sent_before_close(self, ends: Ends) -> None:
        # An unplugged cable loses data that the system has not delivered, so only the end is certain.
        near, far = ends
        far.write(b"last words", PATIENCE_S)
        assert read_exactly(near, 10) == b"last words"
        far.close()
        with pytest.raises(LinkClosed):
            near.read(1, PATIENCE_S)


def test_discards_old_input(far: FarEnd) -> None:
    first = SerialLink.open(far.path, 9600)
    far.write(b"ab", PATIENCE_S)
    assert read_exactly(first, 1) == b"a"
    first.close()
    second = SerialLink.open(far.path, 9600)
    assert second.read(10, 0.0) == b""
    with pytest.raises(LinkTimeout):
        second.read(10, 0.001)
    second.close()


def test_sets_the_speed_of_the_port(far: FarEnd) -> None:
    import termios

    link = SerialLink.open(far.path, 38400)
    probe = os.open(far.path, os.O_RDWR | os.O_NOCTTY)
    _, _, flags, _, speed_in, speed_out, _ = termios.tcgetattr(probe)
    os.close(probe)
    link.close()
    assert (speed_in, speed_out) == (termios.B38400, termios.B38400)
    assert flags & termios.CSIZE == termios.CS8
    assert not flags & (termios.CSTOPB | termios.PARENB)


def test_missing_port_error_lists_present_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    def two_ports() -> list[ListPortInfo]:
        return [ListPortInfo("/dev/ttyUSB1"), ListPortInfo("/dev/ttyACM0")]

    monkeypatch.setattr(list_ports, "comports", two_ports)
    with pytest.raises(LinkClosed, match=r"/dev/ttyUSB7.*/dev/ttyACM0, /dev/ttyUSB1"):
        SerialLink.open("/dev/ttyUSB7", 9600)
    monkeypatch.setattr(list_ports, "comports", list[ListPortInfo])
    with pytest.raises(LinkClosed):
        SerialLink.open("/dev/ttyUSB7", 9600)


@pytest.mark.parametrize(
    ("cause", "error_type", "remedy"),
    [
        (serial.SerialException(errno.EACCES, "Permission denied"), DeviceRefused, "dialout"),
        (serial.SerialException(errno.EIO, "Could not configure port"), LinkClosed, "check that it is a serial port"),
        (ValueError("Not a valid baudrate: 12"), ConfigurationError, "set another speed"),
    ],
)
def test_open_errors_name_the_remedy(
    monkeypatch: pytest.MonkeyPatch, cause: Exception, error_type: type[Exception], remedy: str
) -> None:
    def refuse(*_: object, **__: object) -> serial.Serial:
        raise cause

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(error_type, match=remedy) as caught:
        SerialLink.open("/dev/ttyUSB0", 9600)
    assert "/dev/ttyUSB0" in str(caught.value)
    assert caught.value.__cause__ is cause


def test_refuses_a_second_open_of_a_port(far: FarEnd) -> None:
    link = SerialLink.open(far.path, 9600)
    with pytest.raises(DeviceRefused):
        SerialLink.open(far.path, 9600)
    link.close()
    SerialLink.open(far.path, 9600).close()
