"""Opens what a session is taken with: the one file that knows more of devices than their contracts.

`rig = "simulated"` builds the simulated lab, `rig = "replay"` puts a recorded session into the same simulated
camera. A lab that is taken up again stands where its journal says it stood: same time, lamp burning, same pictures
taken; so an interrupted session ends in the same bytes as an undisturbed one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import fields
from datetime import datetime
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from acquisition.chart import Chart
from acquisition.config import LabSettings, unknown_key
from acquisition.printing import drawing
from acquisition.sequencer import Devices
from acquisition.session import Session
from drivers.errors import ConfigurationError, FormatError
from drivers.pjlink.projector import PjLinkProjector
from drivers.presenter import Colour
from drivers.projector import Power
from drivers.ptp.canon_eos import CanonEos
from sim.bodies import BODIES, Body
from sim.clock import OPENING, SimulatedClock
from sim.eos import SimulatedEos
from sim.eos_bodies import EOS_BODIES
from sim.film import Film, WorldFilm
from sim.presenter import Screen, SimulatedPresenter
from sim.projector import PjLinkPeer, SimulatedProjector, memory_link
from sim.ptp_memory import MemoryTransport
from sim.replay import RecordedFrame, ReplayFilm
from sim.world import Print, Room, World

SERIAL = "0000000001"


@contextmanager
def open_rig(settings: LabSettings, chart: Chart, session: Session | None = None) -> Generator[Devices]:
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
    exposed = _exposed(session)
    clock = SimulatedClock(_last_moment(session) if session is not None else OPENING)
    screen = Screen()
    beamer = SimulatedProjector(clock, power=Power.ON if exposed else Power.STANDBY)
    name = settings.simulated.body
    if settings.rig == "simulated":
        world = World(sheet(chart), simulated_body(settings), simulated_room(settings))
        film: Film = WorldFilm(world, screen, beamer.light, SERIAL, exposed)
    else:
        assert settings.replay is not None
        film = ReplayFilm(_recording(settings.replay.session), screen, exposed)
    eos = SimulatedEos(EOS_BODIES[name], film, clock, serial=SERIAL, auto_power_off_s=0)
    peer = PjLinkPeer(beamer)
    camera = CanonEos(lambda: MemoryTransport(eos), clock)
    presenter = SimulatedPresenter(screen, clock)
    projector = PjLinkProjector(lambda: memory_link(peer))
    try:
        yield Devices(camera, presenter, projector, clock)
    finally:
        presenter.close()
        camera.close()
        projector.close()


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
        raise ConfigurationError(f"simulated.body = {name!r}: known are {', '.join(sorted(BODIES))}")
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
            raise unknown_key(f"simulated.room.{key}", known, "LAB.toml")
    try:
        return TypeAdapter(Room).validate_python({"seed": settings.simulated.seed, **settings.simulated.room})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(["simulated.room", *(str(part) for part in first["loc"][:1])])
        raise ConfigurationError(f"LAB.toml: {key}: {first['msg']}, got {first['input']!r}") from error


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
