"""Opens what a session is taken with: the one file that knows more of devices than their contracts.

`rig = "lab"` opens the devices that LAB.toml names, `rig = "simulated"` builds the simulated lab, `rig = "replay"` puts
a recorded session into the same simulated camera. A simulated lab that is taken up again stands where its journal says
it stood: same time, lamp burning, same pictures taken; so an interrupted session ends in the same bytes as an
undisturbed one.
"""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from acquisition.chart.model import Chart
from acquisition.chart.printing import drawing
from acquisition.config import (
    CameraCable,
    LabSettings,
    LightSource,
    ProjectorCable,
    require_whole_turns,
    unknown_key,
)
from acquisition.run.sequencer import Devices
from acquisition.session.folder import Session
from drivers.camera import Camera
from drivers.canon.camera import CanonEos
from drivers.display.fullscreen import FullScreen, identify_displays, list_displays
from drivers.display.jvc import PORT as JVC_PORT
from drivers.display.jvc import JvcFlatField
from drivers.display.lightcrafter import LightCrafter, find_lightcrafter
from drivers.gphoto2_camera import Gphoto2Camera
from drivers.links.pipes import UsbPipes
from drivers.links.serial import SerialLink, list_serial_ports
from drivers.links.tcp import TcpLink
from drivers.links.usb import list_devices, open_usb
from drivers.pjlink.projector import PjLinkProjector
from drivers.pjlink.search import search
from drivers.pjlink.wire import PORT as PJLINK_PORT
from drivers.presenter import Colour, Presenter
from drivers.projector import Power, Projector
from drivers.ptp.codes import VENDOR_CANON_USB
from drivers.ptp.ip_transport import IpTransport
from drivers.ptp.usb_transport import UsbTransport
from drivers.serial_projectors import language
from foundation.clock import Clock, SystemClock
from foundation.errors import ConfigurationError, CropError, FormatError
from sim.buses.ptp_memory import MemoryTransport
from sim.camera.eos import SimulatedEos
from sim.camera.eos_bodies import EOS_BODIES
from sim.camera.film import Film, WorldFilm
from sim.camera.replay import RecordedFrame, ReplayFilm
from sim.camera.sensors import BODIES, Body
from sim.clock import OPENING, SimulatedClock
from sim.projectors.pjlink import PjLinkPeer, SimulatedProjector, memory_link
from sim.projectors.screen import Screen, SimulatedPresenter
from sim.world.world import Print, Room, World

__all__ = [
    "Attached",
    "attached_devices",
    "identify_displays",
    "open_rig",
    "sheet",
    "simulated_body",
    "simulated_room",
]

SERIAL = "0000000001"
CONNECT_S = 5.0


@contextmanager
def open_rig(
    settings: LabSettings,
    chart: Chart,
    session: Session | None = None,
) -> Generator[Devices]:
    """Open every device that the settings name; close them all at the end, whatever the end.

    Parameters
    ----------
    settings
        As `acquisition.config.load_lab` returns them.
    chart
        What hangs on the wall, for the simulated lab.
    session
        The session that is taken up; None for a look that records nothing.

    Raises
    ------
    ConfigurationError
        The settings name something that does not exist.
    DeviceError
        A device does not answer.
    """
    if settings.rig == "imported":
        raise ConfigurationError(
            'rig = "imported" marks a session whose frames were taken by other means; nothing more can be taken of it'
        )
    with ExitStack() as opened:
        if settings.rig == "lab":
            yield _open_lab(settings, opened)
        else:
            yield _open_simulated(settings, chart, session, opened)


def _open_lab(settings: LabSettings, opened: ExitStack) -> Devices:
    clock = SystemClock()
    require_whole_turns(settings.camera, settings.lab.projector)
    projector = _lab_projector(settings.lab.projector, clock, settings.file)
    if projector is not None:
        opened.callback(projector.close)
    presenter = _lab_presenter(settings.lab.light, clock, settings.file)
    opened.callback(presenter.close)
    camera = _lab_camera(settings.lab.camera, clock, settings.file)
    opened.callback(camera.close)
    return Devices(camera, presenter, projector, clock)


def _lab_camera(cable: CameraCable, clock: Clock, file: str) -> Camera:
    match cable.connection:
        case "usb":
            return CanonEos(lambda: UsbTransport(_usb_pipes(cable), clock), clock)
        case "ptpip":
            host = _required(cable.host, "lab.camera.host", "the camera's address", file)
            # A body remembers the computers it was paired with by this number.
            guid = uuid.uuid5(uuid.NAMESPACE_DNS, f"croplab.{uuid.getnode()}").bytes
            return CanonEos(
                lambda: IpTransport.connect(
                    host, cable.port, event_port=cable.event_port, guid=guid, name="CroP", clock=clock
                ),
                clock,
            )
        case "gphoto2":
            return Gphoto2Camera(cable.gphoto2_port, cable.gphoto2_model, clock)


def _usb_pipes(cable: CameraCable) -> UsbPipes:
    return open_usb(vendor=VENDOR_CANON_USB, serial=cable.serial, port=cable.usb_port)


def _lab_projector(cable: ProjectorCable, clock: Clock, file: str) -> Projector | None:
    if cable.control == "none":
        return None
    if cable.control == "pjlink":
        host = _required(cable.host, "lab.projector.host", "the projector's address", file)
        port = cable.port or PJLINK_PORT
        label = f"the projector at {host}:{port}"
        return PjLinkProjector(lambda: TcpLink.connect(host, port, CONNECT_S), cable.password, label=label, clock=clock)
    spoken = language(cable.control)
    if cable.device is None and cable.host is not None and spoken.network is not None:
        host, port = cable.host, cable.port or spoken.tcp_port
        label = f"the projector at {host}:{port}"
        return spoken.network(lambda: TcpLink.connect(host, port, CONNECT_S), label=label, clock=clock)
    if cable.device is None and cable.host is not None:
        raise ConfigurationError(
            f"{file}: lab.projector.host: {spoken.maker} projectors are reached over a serial port only; "
            "name lab.projector.device, acquire devices lists what is there"
        )
    device = _required(cable.device, "lab.projector.device", "the serial port", file)
    return spoken.projector(
        lambda: SerialLink.open(device, cable.baud or spoken.baud, spoken.parity),
        label=f"the projector at {device}",
        clock=clock,
    )


def _lab_presenter(light: LightSource, clock: Clock, file: str) -> Presenter:
    match light.shown_by:
        case "display":
            return FullScreen(light.display, clock)
        case "lightcrafter":
            return LightCrafter(find_lightcrafter, clock)
        case "jvc":
            host = _required(light.host, "lab.light.host", "the projector's address", file)
            port = light.port or JVC_PORT
            label = f"the JVC projector at {host}:{port}"
            return JvcFlatField(lambda: TcpLink.connect(host, port, CONNECT_S), label=label, clock=clock)


def _required(value: str | None, key: str, what: str, file: str) -> str:
    if value is None:
        raise ConfigurationError(f"{file}: {key} is missing; name {what}, acquire devices lists what is there")
    return value


def _open_simulated(settings: LabSettings, chart: Chart, session: Session | None, opened: ExitStack) -> Devices:
    exposed = _exposed(session)
    clock = SimulatedClock(_last_moment(session) if session is not None else OPENING)
    screen = Screen()
    beamer = SimulatedProjector(clock, power=Power.ON if exposed else Power.STANDBY)
    sensor = simulated_body(settings)
    if settings.rig == "simulated":
        world = World(sheet(chart), sensor, simulated_room(settings))
        film: Film = WorldFilm(world, lambda: screen.colour, beamer.light, SERIAL, exposed)
    else:
        assert settings.replay is not None
        film = ReplayFilm(_recording(settings.replay.session), lambda: screen.colour, exposed)
        film.accept(settings.camera.exposure)
    # On mains power, as a camera that takes 707 frames is.
    body = replace(EOS_BODIES[settings.simulated.body], shots_per_charge=10**9)
    eos = SimulatedEos(body, film, clock, serial=SERIAL, auto_power_off_s=0)
    peer = PjLinkPeer(beamer)
    projector = PjLinkProjector(lambda: memory_link(peer))
    opened.callback(projector.close)
    presenter = SimulatedPresenter(screen, clock)
    opened.callback(presenter.close)
    camera = CanonEos(lambda: MemoryTransport(eos), clock)
    opened.callback(camera.close)
    return Devices(camera, presenter, projector, clock)


def sheet(chart: Chart) -> Print:
    """Return the chart as the simulated room hangs it up."""
    drawn = drawing(chart)
    return Print(drawn.page_mm, drawn.rectangles_mm, drawn.rgb)


def simulated_body(settings: LabSettings) -> Body:
    """Return the simulated camera body that the settings name.

    Raises
    ------
    ConfigurationError
        There is no such body.
    """
    name = settings.simulated.body
    if name not in BODIES:
        raise ConfigurationError(f"{settings.file}: simulated.body = {name!r}: known are {', '.join(sorted(BODIES))}")
    return BODIES[name]


def simulated_room(settings: LabSettings) -> Room:
    """Return the default room with the seed and the changes of the settings.

    Raises
    ------
    ConfigurationError
        A parameter is unknown or of the wrong type.
    """
    known = [field.name for field in fields(Room) if field.name != "seed"]
    for key in settings.simulated.room:
        if key not in known:
            raise unknown_key(f"simulated.room.{key}", known, settings.file)
    try:
        return TypeAdapter(Room).validate_python({"seed": settings.simulated.seed, **settings.simulated.room})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(["simulated.room", *(str(part) for part in first["loc"][:1])])
        raise ConfigurationError(f"{settings.file}: {key}: {first['msg']}, got {first['input']!r}") from error


def _exposed(session: Session | None) -> Counter[Colour]:
    if session is None:
        return Counter()
    colours = {step.number: step.colour for step in session.steps}
    return Counter(colours[attempt.step] for attempt in session.attempts() if attempt.has_frame)


def _last_moment(session: Session) -> datetime:
    ends = [attempt.ended_at for attempt in session.attempts() if attempt.has_frame and attempt.ended_at is not None]
    return max(ends, default=OPENING)


def _recording(folder: Path) -> list[RecordedFrame]:
    with Session.open(folder) as recording:
        colours = {(step.kind, step.illumination): step.colour for step in recording.steps}
        frames = [
            RecordedFrame(colours[frame.kind, frame.illumination], folder / frame.file, frame.exposure_s)
            for frame in recording.frames()
        ]
    if not frames:
        raise FormatError(f"{folder} holds no frames; name a session in which some were taken")
    return frames


@dataclass(frozen=True)
class Attached:
    """What of one kind is attached or reachable: `kind` in the plural, what was found, or why it could not be asked."""

    kind: str
    found: tuple[str, ...]
    trouble: str = ""


def attached_devices(search_s: float) -> Generator[Attached]:
    """Yield what is attached and reachable, kind by kind; a kind that cannot be asked says why.

    Parameters
    ----------
    search_s
        Seconds to collect the answers of PJLink projectors on the network; 0 does not ask.
    """
    yield _attached("cameras on USB", lambda: [str(device) for device in list_devices()])
    yield _attached("serial ports", list_serial_ports)
    yield _attached("displays", lambda: [str(display) for display in list_displays()])
    if search_s > 0:
        yield _attached(
            "projectors by PJLink", lambda: [f"{found.host}, MAC {found.mac}" for found in search(search_s)]
        )


def _attached(kind: str, ask: Callable[[], Iterable[str]]) -> Attached:
    try:
        return Attached(kind, tuple(ask()))
    except CropError as error:
        return Attached(kind, (), str(error))
