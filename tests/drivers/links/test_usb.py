"""USB through pyusb: the PTP contract on the simulated bus, and errors of searching and opening."""

from __future__ import annotations

from importlib import resources

import pytest

from drivers.links.usb import UDEV_RULE, Pipe, PipeStalled, UsbDevice, list_devices, open_usb
from drivers.ptp.protocol import PtpRequest
from drivers.ptp.usb import UsbTransport
from foundation.clock import SimulatedClock
from foundation.errors import DeviceRefused, InputError, LinkClosed, LinkTimeout
from sim.buses.usb import BULK_IN, PtpUsbDevice, Setup, SimulatedBus, UsbIdentity
from tests.contracts.transport import ECHO, PATIENCE_S, Bench, Echo, TransportContract


class TestSimulatedBus(TransportContract):
    @pytest.fixture
    def bench(self) -> Bench:
        responder = Echo()
        device = PtpUsbDevice(responder)
        bus = SimulatedBus()
        bus.plug(device)
        transport = UsbTransport(open_usb(backend=bus), SimulatedClock())
        return Bench(transport, responder, lambda: bus.unplug(device))


def camera(serial: str | None = "1234", product: int = 0x31EA) -> PtpUsbDevice:
    return PtpUsbDevice(Echo(), UsbIdentity(product=product, serial=serial))


def bus_with(*devices: PtpUsbDevice) -> SimulatedBus:
    bus = SimulatedBus()
    for port, device in enumerate(devices, 1):
        bus.plug(device, port)
    return bus


class Keyboard(PtpUsbDevice):
    def configuration_descriptor(self) -> bytes:
        descriptor = bytearray(super().configuration_descriptor())
        descriptor[14:17] = (3, 1, 1)
        return bytes(descriptor)


def test_lists_only_cameras() -> None:
    bus = bus_with(camera(), Keyboard(Echo()), camera(serial=None, product=0x32CA))
    assert list_devices(backend=bus) == (
        UsbDevice(0x04A9, 0x31EA, "1234", "Canon Digital Camera", "1-1", 2),
        UsbDevice(0x04A9, 0x32CA, None, "Canon Digital Camera", "1-3", 4),
    )


def test_opens_by_each_property() -> None:
    bus = bus_with(camera("1"), camera("2"), camera("3", product=0x32CA))
    pipes = open_usb(serial="2", backend=bus)
    assert "serial number 2" in pipes.label
    assert "1-2" in pipes.label
    pipes.close()
    assert "1-1" in open_usb(port="1-1", backend=bus).label
    assert "serial number 3" in open_usb(vendor=0x04A9, serial="3", backend=bus).label


def test_missing_camera_error_lists_present_cameras() -> None:
    with pytest.raises(LinkClosed):
        open_usb(backend=SimulatedBus())
    with pytest.raises(LinkClosed, match=r"serial number 9 .*serial number 1\b"):
        open_usb(serial="9", backend=bus_with(camera("1")))


def test_refuses_several_matching_cameras() -> None:
    with pytest.raises(InputError, match=r"serial number 1\b.*serial number 2\b"):
        open_usb(vendor=0x04A9, backend=bus_with(camera("1"), camera("2")))


def test_camera_in_use_error_names_the_remedy() -> None:
    device = camera()
    bus = bus_with(device)
    bus.hold(device)
    with pytest.raises(DeviceRefused, match="gvfs-gphoto2-volume-monitor"):
        open_usb(backend=bus)
    bus.hold(device, is_held=False)
    open_usb(backend=bus)


def test_permission_error_names_the_udev_rule() -> None:
    device = camera()
    bus = bus_with(device)
    bus.lock(device)
    for serial in (None, "1234"):
        with pytest.raises(DeviceRefused, match=r"70-crop-cameras\.rules"):
            open_usb(serial=serial, backend=bus)
    assert list_devices(backend=bus)[0].serial is None


def test_detaches_and_restores_the_kernel_driver() -> None:
    device = camera()
    bus = bus_with(device)
    bus.bind_kernel_driver(device)
    pipes = open_usb(backend=bus)
    assert not bus.has_kernel_driver(device)
    pipes.close()
    assert bus.has_kernel_driver(device)
    assert not bus.is_claimed(device)


def test_configures_an_unconfigured_device() -> None:
    device = camera()
    bus = bus_with(device)
    device.control(Setup(0x00, 9, 0, 0, 0))
    transport = UsbTransport(open_usb(backend=bus), SimulatedClock())
    assert transport.transact(PtpRequest(ECHO, 1), timeout=PATIENCE_S).response.ok


def test_translates_bus_errors() -> None:
    device = camera()
    bus = bus_with(device)
    pipes = open_usb(backend=bus)
    with pytest.raises(LinkTimeout, match="1234"):
        pipes.bulk_read(512, 0.001)
    assert pipes.interrupt_read(0.001) == b""
    device.halt(BULK_IN)
    with pytest.raises(PipeStalled):
        pipes.bulk_read(512, 0.001)
    pipes.clear_halt(Pipe.BULK_IN)
    with pytest.raises(LinkTimeout):
        pipes.bulk_read(512, 0.001)
    with pytest.raises(PipeStalled):
        pipes.control_in(0x7F, 4, 0.001)
    bus.unplug(device)
    with pytest.raises(LinkClosed):
        pipes.bulk_write(b"x", 0.001)
    with pytest.raises(LinkClosed):
        pipes.interrupt_read(0.001)
    pipes.close()
    with pytest.raises(LinkClosed):
        pipes.bulk_write(b"x", 0.001)


def test_reopens_a_restarted_camera_by_serial_number() -> None:
    device = camera("7")
    bus = bus_with(camera("6"), device)
    transport = UsbTransport(open_usb(serial="7", backend=bus), SimulatedClock())
    old_devices = list_devices(backend=bus)
    bus.replug(device)
    with pytest.raises(LinkClosed):
        transport.transact(PtpRequest(ECHO, 1), timeout=PATIENCE_S)
    transport.close()
    reopened = UsbTransport(open_usb(serial="7", backend=bus), SimulatedClock())
    assert reopened.transact(PtpRequest(ECHO, 1), timeout=PATIENCE_S).response.ok
    assert {device.address for device in old_devices} != {device.address for device in list_devices(backend=bus)}
    assert {device.port for device in old_devices} == {device.port for device in list_devices(backend=bus)}


def test_port_reset_keeps_the_pipes() -> None:
    device = camera()
    pipes = open_usb(backend=bus_with(device))
    transport = UsbTransport(pipes, SimulatedClock())
    pipes.reset_port()
    assert transport.transact(PtpRequest(ECHO, 1), timeout=PATIENCE_S).response.ok


def test_udev_rule_is_shipped() -> None:
    rule = resources.files("drivers") / "data" / UDEV_RULE
    lines = [line for line in rule.read_text().splitlines() if line and not line.startswith("#")]
    assert len(lines) == 1
    # udev.rules(7): the vendor as in sysfs, the interfaces as udev lists them, :class subclass protocol:.
    assert 'ATTR{idVendor}=="04a9"' in lines[0]
    assert 'ENV{ID_USB_INTERFACES}=="*:060101:*"' in lines[0]
    assert 'TAG+="uaccess"' in lines[0]
