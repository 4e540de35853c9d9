"""Short sessions in simulated rooms, some of whose frames are not what the plan says, and their tables against truth.

A `FrameChange` says how one frame differs: another light or camera, another exposure or file header, something in the
room, counts painted over. `frames_of` makes the files of a plan, `record_session` a session of them, `compare` holds a
table against the room that it should show: the session's own camera, room and chart with nothing else in them.

Noise is no error of a table. The counts that the same frame has without noise are known here, so that what noise adds
to each cell's mean is taken out cell by cell, and what remains is systematic, hot photosites included.
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.measurements import FrameMeasurements
from calibration.registration.register import Registration
from calibration.sampling import sites_at
from calibration.table.lut import CELLS, Lut
from calibration.verdict import BuildResult
from drivers.camera import CapturedFrame, ExposureSettings
from drivers.presenter import BLACK, Colour
from drivers.raw.rawfile import CHANNELS, read_raw
from experiment.chart.model import Chart
from experiment.chart.printing import drawing
from experiment.framing.pictures import STILL_PX
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.journal import ReceivedFile
from experiment.session.records import Judgement, SessionStep, plan_steps
from foundation.colorimetry import angles_deg
from sim.camera.film import write_dng
from sim.world.rendering import Print
from sim.world.sensors import Body
from sim.world.world import PAPER, UNDISTURBED, Room, Situation, World

SETTINGS = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.5)
TAKEN_AT = datetime(2024, 3, 1, 9, 0, tzinfo=UTC)
SECONDS_A_FRAME = 4
WELL_LIT_DN = 300.0

EIGHT_LIGHTS: Mapping[str, Colour] = {
    "red": Colour(255, 0, 0),
    "green": Colour(0, 255, 0),
    "blue": Colour(0, 0, 255),
    "white": Colour(255, 255, 255),
    "warm": Colour(255, 164, 73),
    "cool": Colour(200, 218, 255),
    "violet": Colour(180, 60, 255),
    "dim": Colour(110, 70, 20),
}
"""The lights of a short session by name: the primaries, white, a warm and a cool white, two mixtures."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]
_Counts = npt.NDArray[np.uint16]


def short_plan(lights: Mapping[str, Colour] = EIGHT_LIGHTS) -> tuple[Illuminant, ...]:
    """Return named lights as a session's plan."""
    return tuple(
        Illuminant(index, "uniform", None, colour, name) for index, (name, colour) in enumerate(lights.items())
    )


@lru_cache(maxsize=1)
def world_of(chart: Chart, body: Body, room: Room) -> World:
    """Return a chart in a room before a camera; the last one again, whose light is as long to compute as ten frames."""
    return World(_printed(chart), body, room)


@lru_cache(maxsize=4)
def _printed(chart: Chart) -> Print:
    """Return a chart's print; marks in its margins take seconds to find a place for."""
    picture = drawing(chart)
    return Print(picture.page_mm, picture.rectangles_mm, picture.rgb)


@dataclass(frozen=True, eq=False)
class FrameChange:
    """How one frame differs from what the plan says.

    - `colour`: what the projector shows instead: the file is of another light.
    - `settings`: how it is exposed, and what its file says.
    - `tagged`: what its file says where that is not how it was exposed.
    - `world`: another camera, room or chart that it is taken of.
    - `situation`: what is otherwise in the room.
    - `counts_added`: photosites of the sensor, (row, column) from its corner, and what is added to their counts.
    - `serial`: of the body, in the file.
    - `reason`: why the frame was refused; None: it is accepted.
    - `number`: the step whose frame it is, by noise and time; None: its own.
    """

    colour: Colour | None = None
    settings: ExposureSettings = SETTINGS
    tagged: ExposureSettings | None = None
    world: World | None = None
    situation: Situation = UNDISTURBED
    counts_added: Mapping[tuple[int, int], int] = field(default_factory=dict[tuple[int, int], int])
    serial: str = "000000000000"
    reason: str | None = None
    number: int | None = None


AS_PLANNED = FrameChange()
"""Nothing is otherwise."""

Changes = Callable[[SessionStep], FrameChange]


def as_planned(step: SessionStep) -> FrameChange:
    """Return that nothing is otherwise."""
    return AS_PLANNED


def light_named(lights: Sequence[Illuminant], step: SessionStep) -> str | None:
    """Return the name of a step's light; None for references."""
    return None if step.illumination is None else lights[step.illumination].name


def counts_of(world: World, step: SessionStep, change: FrameChange = AS_PLANNED) -> _Counts:
    """Return the whole sensor's counts of a step's frame; its noise depends on the room and the step's number alone."""
    seen, number = change.world or world, _number_of(step, change)
    counts = seen.expose(change.colour or step.colour, change.settings, key=(number,), situation=change.situation)
    for place, added in change.counts_added.items():
        counts[place] = min(int(counts[place]) + added, seen.body.saturation)
    return counts


def _number_of(step: SessionStep, change: FrameChange) -> int:
    return step.number if change.number is None else change.number


def expected_counts(world: World, step: SessionStep, change: FrameChange = AS_PLANNED) -> npt.NDArray[np.float32]:
    """Return the visible photosites' counts above black, (rows, columns) float32, that the frame has without noise."""
    seen = change.world or world
    expected = seen.signal(change.colour or step.colour, change.settings, situation=change.situation)
    visible, body = seen.body.visible, seen.body
    rows, columns = seen.hot.rows - visible.top, seen.hot.columns - visible.left
    inside = (rows >= 0) & (rows < visible.height) & (columns >= 0) & (columns < visible.width)
    excess = seen.hot.excess_dn(change.settings.iso, change.settings.shutter_s)
    expected[rows[inside], columns[inside]] += excess[inside].astype(np.float32)
    for (row, column), added in change.counts_added.items():
        expected[row - visible.top, column - visible.left] += added
    return np.minimum(expected, body.saturation - body.black, out=expected)


def frame_file(world: World, step: SessionStep, change: FrameChange = AS_PLANNED) -> bytes:
    """Return the raw file of a step's frame."""
    stream, body = BytesIO(), (change.world or world).body
    write_dng(
        stream,
        counts_of(world, step, change),
        body,
        settings=change.tagged or change.settings,
        taken_at=TAKEN_AT + timedelta(seconds=SECONDS_A_FRAME * _number_of(step, change)),
        serial=change.serial,
    )
    return stream.getvalue()


def record_session(
    folder: Path,
    chart: Chart,
    lights: Sequence[Illuminant],
    frame: Callable[[SessionStep], bytes],
    *,
    every: int = 25,
    reason: Callable[[SessionStep], str | None] | None = None,
    settings: str = "rig = 'simulated'\n",
    steps: Sequence[SessionStep] | None = None,
) -> Session:
    """Return an open session with a frame for every step of its plan.

    `settings`: as `session.toml` has them. `reason`: why a step's frame is refused; None where it is accepted. `steps`:
    the plan, if it is not the usual one.
    """
    with Session.create(folder, settings, chart, lights) as session:
        for step in plan_steps(lights, every) if steps is None else steps:
            data = frame(step)
            at = TAKEN_AT + timedelta(seconds=SECONDS_A_FRAME * step.number)
            path = session.frames_folder / f"{step.stem}.dng"
            attempt = session.journal.begin(step, f"frames/{path.name}", at)
            path.write_bytes(data)
            captured = CapturedFrame(path.name, len(data), at)
            received = ReceivedFile(path, len(data), hashlib.sha256(data).hexdigest(), captured)
            judgement = Judgement.of_reason("exposure", None if reason is None else reason(step))
            session.journal.commit(attempt, received, judgement, exposure_s=SETTINGS.shutter_s, ended_at=at)
        session.write_frames_csv()
    return Session.open(folder)


def short_session(
    folder: Path,
    chart: Chart,
    world: World,
    changes: Changes = as_planned,
    lights: Sequence[Illuminant] | None = None,
    every: int = 25,
    settings: str = "rig = 'simulated'\n",
) -> Session:
    """Return an open session of a few lights whose frames differ from the plan as they are said to.

    A session without the file of a frame is made by a plan without its light.
    """
    return record_session(
        folder,
        chart,
        short_plan() if lights is None else lights,
        lambda step: frame_file(world, step, changes(step)),
        every=every,
        reason=lambda step: changes(step).reason,
        settings=settings,
    )


@dataclass(frozen=True, eq=False)
class TableTruth:
    """A table against the room that it should show; L lights, C cells.

    - `light_deg`: (L,) float64, angle between the ground truth and bare paper's light, its mean over the cells, less
      dark light where the table lacks it.
    - `light_stated`, `cell_stated`: (L,) float64 degrees and (C, 3) float64, what the table states of both.
    - `brightness`: (L,) float64, the light's brightness over the truth, 1 for the median light.
    - `level`: (L, C, 3) float64 counts that cells should have in the table.
    - `error`: (L, C, 3) float64, mean of the samples over the truth, less 1, noise taken out; the light's own error and
      its brightness are not in it.
    - `fit`: (C,) bool, cells that the table lists as fit for use.
    - `offset_px`: (3, C, 2) float64, by channel: where cells were found less where they are seen, half-size px.
    """

    light_deg: _Array
    light_stated: _Array
    cell_stated: _Array
    brightness: _Array
    level: _Array
    error: _Array
    fit: _Mask
    offset_px: _Array

    @property
    def lit(self) -> _Mask:
        """(L, C, 3) bool: means of fit cells from 300 counts on."""
        return (self.level >= WELL_LIT_DN) & self.fit[:, None]

    @property
    def rms(self) -> float:
        """Root mean square of `error` where cells are lit."""
        return float(np.sqrt((self.error[self.lit] ** 2).mean())) if self.lit.any() else 0.0

    @property
    def worst(self) -> float:
        """Largest of `error` where cells are lit."""
        return float(np.abs(self.error[self.lit]).max(initial=0))

    @property
    def cell_error(self) -> _Array:
        """(L, C, 3) float64, size of the errors of cells' means, their light's brightness included."""
        return np.abs((1 + self.error) * self.brightness[:, None, None] - 1)

    def cells_beyond(self, share: float) -> int:
        """Return how many fit cells are off by more than a share under some light, in some channel, where lit."""
        return int((self.lit & (np.abs(self.error) > share)).any(axis=(0, 2)).sum())

    def offset_rms_px(self) -> tuple[float, float, float]:
        """Return the RMS distance of cell centres from the truth in red, green and blue."""
        red, green, blue = np.sqrt((self.offset_px**2).sum(axis=-1).mean(axis=-1)).tolist()
        return red, green, blue

    def worst_offset_px(self) -> float:
        """Return the largest distance of a fit cell's centre from the truth, in the channel where it is largest."""
        return float(np.linalg.norm(self.offset_px[:, self.fit], axis=-1).max(initial=0))


def compare(
    result: BuildResult,
    lut: Lut,
    world: World,
    chart: Chart,
    session: Session,
    changes: Changes = as_planned,
    every: int = 25,
) -> TableTruth:
    """Return a table compared with the room that it should show."""
    lights = lut.illuminations
    cells_mm = chart.centres_mm[chart.cell_of_colour]
    codes = chart.rgb[chart.cell_of_colour]
    paper = [PAPER] * len(cells_mm)
    white = np.array([world.camera_rgb_at(paper, cells_mm, light.colour, SETTINGS).mean(axis=0) for light in lights])
    if result.figures.lights.subtracted is not None:
        white -= world.camera_rgb_at(paper, cells_mm, BLACK, SETTINGS).mean(axis=0)
    records = {frame.record.illumination: frame for frame in result.figures.frames if frame.record.kind == "light"}
    steps = {step.illumination: step for step in plan_steps(lights, every) if step.kind == "light"}
    level, error = (np.zeros((len(lights), len(codes), 3)) for _ in range(2))
    for number, light in enumerate(lights):
        relative = world.reflected(codes, light.colour, SETTINGS) / world.white(light.colour, SETTINGS)
        level[number] = relative * lut.white[number]
        means = lut.samples[number].astype(np.float64).mean(axis=1)
        figures, change = records[number], changes(steps[number])
        noise = noise_of(
            session.folder / figures.record.file,
            (change.world or world).body,
            expected_counts(world, steps[number], change),
            _places_px(result, figures, world, change, cells_mm),
            lut.samples.shape[2],
        )
        means -= noise / figures.paper.field.at(cells_mm)
        error[number] = means / level[number] - 1
    share = (lut.white / white).max(axis=1)
    unfit = [cell.colour for cell in lut.provenance.unfit]
    fit = np.ones(len(codes), dtype=np.bool_)
    fit[unfit] = False
    offset = offsets_px(result.figures.registration, world, cells_mm, session.folder / records[0].record.file)
    stated_light = lut.truth_uncertainty_deg
    assert stated_light is not None
    light = angles_deg(white, lut.white)
    return TableTruth(light, stated_light, stated_of_cells(lut), share / np.median(share), level, error, fit, offset)


def stated_of_cells(lut: Lut) -> _Array:
    """Return (C, 3) float64: the expanded relative uncertainty (k = 2) that a table states of its cells' means."""
    return np.loadtxt(lut.folder / CELLS, delimiter=",", skiprows=1)[:, 1:]


def noise_of(
    file: Path,
    body: Body,
    expected: npt.NDArray[np.float32],
    places_px: _Array,
    samples: int,
) -> _Array:
    """Return (C, 3) float64 counts: what noise adds to the means of cells in one frame.

    `expected`: (rows, columns) float32 counts above black of its visible photosites without noise. `places_px`: (C, 2)
    float64, where the cells lie in the frame as read, half-size px.
    """
    from cv2 import BORDER_REPLICATE, boxFilter

    mosaic = read_raw(file)
    top, left, height, width = body.visible
    noise = mosaic.sensor[top : top + height, left : left + width].astype(np.float32) - body.black - expected
    first_row, first_column = mosaic.visible.top - top, mosaic.visible.left - left
    rows, columns = mosaic.block_planes().shape[2:]
    side = round(samples**0.5)
    sites = sites_at(places_px, (rows, columns), side)
    inside = sites.inside
    means = np.zeros((len(places_px), 3))
    for place, letter in enumerate(mosaic.pattern):
        row, column = first_row + place // 2, first_column + place % 2
        plane = np.ascontiguousarray(noise[row::2, column::2][:rows, :columns])
        boxed = np.asarray(boxFilter(plane, -1, (side, side), borderType=BORDER_REPLICATE))
        found = boxed[sites.rows[inside], sites.columns[inside]] / mosaic.pattern.count(letter)
        means[inside, CHANNELS.index(letter)] += found
    return means


def _places_px(
    result: BuildResult, figures: FrameMeasurements, world: World, change: FrameChange, cells_mm: _Array
) -> _Array:
    """Return (C, 2) float64: where cells were sampled in a frame, nearly, if the chart was found anew in it."""
    registration, anew = result.figures.registration, any(frame.reregistered for frame in result.figures.frames)
    if not anew or change.situation == UNDISTURBED:
        still = math.hypot(figures.shift.dx, figures.shift.dy) <= STILL_PX
        return (registration if still else registration.shifted(figures.shift.dx, figures.shift.dy)).to_pixels(cells_mm)
    found = registration.to_pixels(cells_mm) - world.project(cells_mm)
    return found + world.project(cells_mm, situation=change.situation)


def offsets_px(registration: Registration, world: World, points_mm: _Array, file: Path) -> _Array:
    """Return (3, N, 2) float64: where points of the print were found in each channel less where they are seen."""
    mosaic = read_raw(file)
    visible = world.body.visible
    crop = np.array([mosaic.visible.left - visible.left, mosaic.visible.top - visible.top]) / 2
    return np.stack(
        [
            found_px(registration, points_mm, channel) - (world.project(points_mm, channel) - crop)
            for channel in CHANNELS
        ]
    )


def found_px(registration: Registration, points_mm: _Array, channel: str) -> _Array:
    """Return (N, 2) float64: where a registration has points of the print in a channel, if it tells channels apart."""
    to_pixels: Callable[..., _Array] = registration.to_pixels
    return (
        to_pixels(points_mm, channel) if "channel" in inspect.signature(to_pixels).parameters else to_pixels(points_mm)
    )
