"""Open the devices of a real laboratory as set in LAB.toml, and list the available devices."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from acquisition.run.devices import Devices, DryRunPresenter, ask_all, require_whole_turns
from drivers.camera import Camera
from drivers.canon import CanonEos
from drivers.display.fullscreen import FullScreen, display_warnings, identify_displays, list_displays
from drivers.gphoto2_camera import Gphoto2Camera
from drivers.links.network import TcpLink
from drivers.links.serial import SerialLink, list_serial_ports
from drivers.links.usb import list_devices, open_usb
from drivers.pjlink import PORT as PJLINK_PORT
from drivers.pjlink import PjLinkProjector, search
from drivers.presenter import Presenter
from drivers.projector import Projector
from drivers.ptp.codes import VENDOR_CANON_USB
from drivers.ptp.ip import IpTransport
from drivers.ptp.usb import UsbTransport
from drivers.serial_projectors.driver import LineProjector
from drivers.serial_projectors.language import built_in_languages, load_language
from experiment.config import CameraCable, LabSettings, ProjectorCable
from experiment.session.folder import Session
from experiment.session.records import last_frame_time
from foundation.clock import Clock, SteadyClock, SystemClock
from foundation.errors import ConfigurationError, CropError
from foundation.holds import hold

__all__ = ["Attached", "attached_devices", "identify_displays"]


CONNECT_S = 5.0  # Longest time for a projector to accept a connection, s


def open_lab(settings: LabSettings, session: Session | None, opened: ExitStack, opens_display: bool = True) -> Devices:
    """Open the camera, the projector and its display.

    `session`: the resumed session, after whose last frame the clock continues; None for a new session. `opens_display`:
    whether to open the display; if not, a `DryRunPresenter` replaces it.
    """
    _hold_lab(settings.file, opened)
    clock = session_clock(session)
    require_whole_turns(settings.camera, settings.lab.projector)
    projectors: list[Projector | None] = []
    presenters: list[Presenter] = []
    cameras: list[Camera] = []

    def open_projector() -> None:
        projector = _lab_projector(settings.lab.projector, clock, settings.file)
        if projector is not None:
            opened.callback(projector.close)
            projector.identity()
        projectors.append(projector)

    def open_camera() -> None:
        camera = _lab_camera(settings.lab.camera, clock, settings.file)
        opened.callback(camera.close)
        camera.identity()
        cameras.append(camera)

    def open_presenter() -> None:
        display = settings.lab.light.display
        if opens_display and cameras and projectors:
            presenters.append(FullScreen(display, clock))
        else:
            presenters.append(DryRunPresenter(display_warnings(display)))
        opened.callback(presenters[0].close)

    # All faults are reported together. The display is opened last, and only if camera and projector are free, because
    # it would cover the picture of another run.
    ask_all({"camera": open_camera, "projector": open_projector, "display": open_presenter})
    return Devices(cameras[0], presenters[0], projectors[0], clock)


def _hold_lab(file: str, opened: ExitStack) -> None:
    # Lock the laboratory, because two programs on one cable would read each other's answers. Settings without a file
    # need no lock, because no other command can use them.
    with suppress(OSError):
        status = Path(file).stat()
        opened.enter_context(hold(f"the lab of {file}", f"lab {status.st_dev} {status.st_ino}"))


def session_clock(session: Session | None) -> SteadyClock:
    """Return the computer's clock, which is never behind the last frame of a session."""
    return SteadyClock(SystemClock(), None if session is None else last_frame_time(session.journal.attempts()))


def _lab_camera(cable: CameraCable, clock: Clock, file: str) -> Camera:
    match cable.connection:
        case "usb":
            usb = partial(open_usb, vendor=VENDOR_CANON_USB, serial=cable.serial, port=cable.usb_port)
            if cable.host is not None:
                raise ConfigurationError(
                    'lab.camera.host is given, but lab.camera.connection is "usb"',
                    about=file,
                    remedy='write connection = "ptpip" for a camera on the network, or delete host',
                )
            return CanonEos(lambda: UsbTransport(usb(), clock), clock)
        case "ptpip":
            host = _required(cable.host, "lab.camera.host", "the camera's address", file)
            # The camera recognises a paired computer by this number.
            guid = uuid.uuid5(uuid.NAMESPACE_DNS, f"croplab.{uuid.getnode()}").bytes
            return CanonEos(
                lambda: IpTransport.connect(
                    host, cable.port, event_port=cable.event_port, guid=guid, name="CroP", clock=clock
                ),
                clock,
            )
        case "gphoto2":
            return Gphoto2Camera(cable.gphoto2_port, cable.gphoto2_model, clock)


def _lab_projector(cable: ProjectorCable, clock: Clock, file: str) -> Projector | None:
    if cable.control == "none":
        return None
    if cable.host is not None and cable.device is not None:
        raise ConfigurationError(
            "lab.projector.host and lab.projector.device are both given, but only one can control the projector",
            about=file,
            remedy="delete the one that is not used",
        )
    if cable.control == "serial":
        return _line_projector(cable, clock, file)
    if cable.device is not None:
        raise ConfigurationError(
            "lab.projector.device is a serial port, but PJLink needs the network",
            about=file,
            remedy='give the address of the projector as host, or write control = "serial" and its language',
        )
    host = _required(cable.host, "lab.projector.host", "the projector's address", file)
    port = cable.port or PJLINK_PORT
    label = f"the projector at {host}:{port}"
    return PjLinkProjector(lambda: TcpLink.connect(host, port, CONNECT_S), cable.password, label=label, clock=clock)


def _line_projector(cable: ProjectorCable, clock: Clock, file: str) -> LineProjector:
    if cable.language is None:
        raise ConfigurationError(
            "lab.projector.language is missing",
            about=file,
            remedy=f"set one of {', '.join(built_in_languages())}, or a language file",
            value="lab.projector.language",
        )
    language = load_language(cable.language)
    if cable.host is not None:
        if language.network is None:
            raise ConfigurationError(
                f"lab.projector.host is given, but {language.maker} projectors have only a serial port",
                about=file,
                remedy="set lab.projector.device; acquire devices lists the serial ports",
            )
        host, port = cable.host, cable.port or language.network.port
        label = f"the projector at {host}:{port}"
        return LineProjector(language, lambda: TcpLink.connect(host, port, CONNECT_S), True, label, clock)
    device = _required(cable.device, "lab.projector.device", "the serial port", file)
    baud = cable.baud or language.line.baud
    return LineProjector(
        language, lambda: SerialLink.open(device, baud), label=f"the projector at {device}", clock=clock
    )


def _required(value: str | None, key: str, meaning: str, file: str) -> str:
    if value is None:
        remedy = f"set it to {meaning}; acquire devices lists the available devices"
        raise ConfigurationError(f"{key} is missing", about=file, remedy=remedy, value=key)
    return value


@dataclass(frozen=True)
class Attached:
    """Available devices of one kind, or the reason why they could not be listed; `kind` is a plural."""

    kind: str
    found: tuple[str, ...]
    trouble: str = ""


def attached_devices() -> Generator[Attached]:
    """Yield the available devices, kind by kind."""
    yield _attached("cameras on USB", lambda: [str(device) for device in list_devices()])
    yield _attached("serial ports", list_serial_ports)
    yield _attached("displays", lambda: [str(display) for display in list_displays()])
    yield _attached("projectors by PJLink", lambda: [f"{device.host}, MAC {device.mac}" for device in search()])


def _attached(kind: str, list_names: Callable[[], Iterable[str]]) -> Attached:
    try:
        return Attached(kind, tuple(list_names()))
    except CropError as error:
        return Attached(kind, (), str(error))
