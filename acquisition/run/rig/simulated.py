"""The simulated lab: real drivers over memory, with a camera, a projector and a room at the far end of their wires.

A simulated lab that is taken up again is in the state that the session's journal gives: same time, lamp burning, same
pictures taken; so an interrupted session ends in the same bytes as an undisturbed one.
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
from foundation.errors import ConfigurationError
from sim.buses.usb import MemoryTransport
from sim.camera.bodies import EOS_BODIES
from sim.camera.eos import SimulatedEos
from sim.camera.film import WorldFilm
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import Screen, SimulatedPresenter, SimulatedProjector
from sim.spectral import known_sensitivities
from sim.world.disturbances import read_disturbances
from sim.world.rendering import Print
from sim.world.sensors import BODIES, Body, find_body
from sim.world.world import Room, World, read_room

SERIAL = "0000000001"  # Serial number of the simulated body, on its wire and in its frames; one lab has one body


def open_simulated(settings: LabSettings, chart: Chart, session: Session | None, opened: ExitStack) -> Devices:
    """Build the simulated lab.

    `session`: the session that is taken up; None for a check that records nothing.
    """
    before = _taken_before(session)
    exposed = Counter(colour for _, colour in before)
    last = None if session is None else last_frame_time(session.journal.attempts())
    clock = SimulatedClock(last or SIM_START)
    screen = Screen()
    simulated = SimulatedProjector(clock, power=Power.ON if exposed else Power.STANDBY)
    sensor = simulated_body(settings)
    world = World(sheet(chart), sensor, simulated_room(settings))
    events = read_disturbances(settings.simulated.events, settings.file)
    film = WorldFilm(world, lambda: screen.colour, simulated.light, SERIAL, exposed, events, before)
    # On mains power, as a camera that takes 707 frames is.
    # A body of sensitivities alone speaks as an EOS 550D does: only what its sensor sees is its own.
    spoken = EOS_BODIES.get(settings.simulated.body, EOS_BODIES["EOS 550D"])
    apertures = () if settings.camera.exposure.aperture is None else spoken.aperture_codes
    body = replace(spoken, shots_per_charge=10**9, aperture_codes=apertures)
    eos = SimulatedEos(body, film, clock, serial=SERIAL, auto_power_off_s=0)
    peer = PjLinkPeer(simulated)
    projector = PjLinkProjector(lambda: PeerLink(peer))
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
    """Return the simulated camera body that the settings name."""
    name, changes = settings.simulated.body, settings.simulated.camera or {}
    if name not in BODIES and name not in known_sensitivities() and not Path(name).is_file():
        known = ", ".join([*sorted(BODIES), *known_sensitivities()])
        said = f"simulated.body = {name!r}: known are {known}"
        raise ConfigurationError(said, about=settings.file, value=name)
    return find_body(name, changes, settings.file, "simulated.camera")


def simulated_frame_bytes(settings: LabSettings) -> int:
    """Return the size of a raw file that the simulated camera writes: 16 bits a photosite."""
    rows, columns = simulated_body(settings).sensor
    return 2 * rows * columns


def simulated_room(settings: LabSettings) -> Room:
    """Return the default room with the seed and the changes of the settings."""
    return read_room(settings.simulated.seed, settings.simulated.room, settings.file, "simulated.room")


def _taken_before(session: Session | None) -> list[tuple[float, Colour]]:
    """Return the second since the opening, and the colour, of every picture that was taken before."""
    if session is None:
        return []
    colours = {step.number: step.colour for step in session.steps}
    return [
        ((attempt.started_at - SIM_START).total_seconds(), colours[attempt.step])
        for attempt in session.journal.attempts()
        if attempt.has_frame
    ]
