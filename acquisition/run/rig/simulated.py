"""Build the simulated laboratory: real drivers, connected in memory to a simulated camera, projector and room.

If a session is resumed, the time, the lamp and the number of frames continue as in its journal. An interrupted session
therefore gives the same files as an uninterrupted session.
"""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from acquisition.run.devices import Devices
from drivers.canon import CanonEos
from drivers.links.link import PeerLink
from drivers.pjlink import PjLinkProjector
from drivers.presenter import Colour
from drivers.projector import Power
from experiment.chart.model import Chart
from experiment.chart.printing import drawing
from experiment.config import LabSettings
from experiment.session.folder import Session
from experiment.session.records import last_frame_time
from foundation.clock import SIM_START, SimulatedClock
from foundation.errors import ConfigurationError, nearest_names
from sim.buses.usb import MemoryTransport
from sim.camera.bodies import eos_with
from sim.camera.eos import SimulatedEos
from sim.camera.film import WorldFilm
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import Screen, SimulatedPresenter, SimulatedProjector
from sim.spectral import OTHER_CAMERA, known_sensitivities
from sim.world.disturbances import read_disturbances
from sim.world.rendering import Print
from sim.world.sensors import BODIES, Body, find_body
from sim.world.world import Room, World, read_room

SERIAL = "0000000001"  # Serial number of the simulated camera, also in its frames


def open_simulated(settings: LabSettings, chart: Chart, session: Session | None, opened: ExitStack) -> Devices:
    """Build the simulated laboratory; `session` is the resumed session, or None."""
    exposures = _earlier_exposures(session)
    colour_counts = Counter(colour for _, colour in exposures)
    last = None if session is None else last_frame_time(session.journal.attempts())
    clock = SimulatedClock(last or SIM_START)
    screen = Screen()
    simulated_projector = SimulatedProjector(clock, power=Power.ON if exposures else Power.STANDBY)
    sensor = simulated_body(settings)
    world = World(sheet(chart), sensor, simulated_room(settings))
    events = read_disturbances(settings.simulated.events, settings.file)
    film = WorldFilm(world, lambda: screen.colour, simulated_projector.light, SERIAL, colour_counts, events, exposures)
    protocol = eos_with(sensor, settings.simulated.body)
    apertures = () if settings.camera.exposure.aperture is None else protocol.aperture_codes
    # The battery never runs empty, because cameras run on mains power in a long session.
    body = replace(protocol, shots_per_charge=10**9, aperture_codes=apertures)
    eos = SimulatedEos(body, film, clock, serial=SERIAL, auto_power_off_s=0)
    peer = PjLinkPeer(simulated_projector)
    projector = PjLinkProjector(lambda: PeerLink(peer))
    opened.callback(projector.close)
    presenter = SimulatedPresenter(screen, clock)
    opened.callback(presenter.close)
    camera = CanonEos(lambda: MemoryTransport(eos), clock)
    opened.callback(camera.close)
    return Devices(camera, presenter, projector, clock)


def sheet(chart: Chart) -> Print:
    """Return the chart as it hangs in the simulated room."""
    drawn = drawing(chart)
    return Print(drawn.page_mm, drawn.rectangles_mm, drawn.rgb)


def simulated_body(settings: LabSettings) -> Body:
    """Return the simulated camera of the settings."""
    name, changes = settings.simulated.body, settings.simulated.camera or {}
    if name not in BODIES and name not in known_sensitivities() and not Path(name).is_file():
        near = f"{nearest_names(name, [*BODIES, *known_sensitivities()], 3)} ".lstrip()
        problem = f"simulated.body is {name!r}, expected a camera or a file of sensitivities; {near}{OTHER_CAMERA}"
        raise ConfigurationError(problem, about=settings.file, value=name)
    return find_body(name, changes, settings.file, "simulated.camera")


def simulated_frame_bytes(settings: LabSettings) -> int:
    """Return the size of a simulated raw file, bytes: 2 bytes for each photosite."""
    rows, columns = simulated_body(settings).sensor
    return 2 * rows * columns


def simulated_room(settings: LabSettings) -> Room:
    """Return the room of the settings: the default room with their seed and changes."""
    return read_room(settings.simulated.seed, settings.simulated.room, settings.file, "simulated.room")


def _earlier_exposures(session: Session | None) -> list[tuple[float, Colour]]:
    # Return time (seconds since `SIM_START`) and colour of every earlier exposure.
    if session is None:
        return []
    colours = {step.number: step.colour for step in session.steps}
    return [
        ((attempt.started_at - SIM_START).total_seconds(), colours[attempt.step])
        for attempt in session.journal.attempts()
        if attempt.has_frame
    ]
