from array import array
from collections.abc import Callable, Iterator

from usb.backend import IBackend

class USBError(OSError):
    backend_error_code: int | None
    def __init__(self, strerror: str, error_code: int | None = None, errno: int | None = None) -> None: ...

class USBTimeoutError(USBError): ...
class NoBackendError(ValueError): ...

class Endpoint:
    bEndpointAddress: int
    bmAttributes: int
    wMaxPacketSize: int
    bInterval: int

class Interface:
    bInterfaceNumber: int
    bInterfaceClass: int
    bInterfaceSubClass: int
    bInterfaceProtocol: int
    def __iter__(self) -> Iterator[Endpoint]: ...

class Configuration:
    bConfigurationValue: int
    def __iter__(self) -> Iterator[Interface]: ...

class Device:
    idVendor: int
    idProduct: int
    iProduct: int
    iSerialNumber: int
    bus: int | None
    address: int | None
    port_numbers: tuple[int, ...] | None
    def __iter__(self) -> Iterator[Configuration]: ...
    def get_active_configuration(self) -> Configuration: ...
    def set_configuration(self, configuration: int | None = None) -> None: ...
    def write(self, endpoint: int, data: bytes, timeout: int | None = None) -> int: ...
    def read(self, endpoint: int, size_or_buffer: int, timeout: int | None = None) -> array[int]: ...
    def ctrl_transfer(
        self,
        bmRequestType: int,
        bRequest: int,
        wValue: int = 0,
        wIndex: int = 0,
        data_or_wLength: bytes | int | None = None,
        timeout: int | None = None,
    ) -> array[int]: ...
    def clear_halt(self, ep: int) -> None: ...
    def reset(self) -> None: ...
    def is_kernel_driver_active(self, interface: int) -> bool: ...
    def detach_kernel_driver(self, interface: int) -> None: ...
    def attach_kernel_driver(self, interface: int) -> None: ...

def find(
    find_all: bool = False,
    backend: IBackend | None = None,
    custom_match: Callable[[Device], bool] | None = None,
) -> Iterator[Device]: ...
